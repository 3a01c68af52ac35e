"""The provenance in a sweep's `settings.json`, and results of other settings, which its folder refuses."""

import dataclasses
import json
import shlex
from pathlib import Path

import pytest

from actors.evaluation.result_table import LEARNED, ResultRow, read_table, write_table
from deploy.cli import parse
from deploy.options.training import Sweep
from deploy.runs.sweep_provenance import read_provenance, sweep_command
from deploy.runs.sweep_results import SweepResults
from learner.sweep.grid import SweepConfig, cell_hash, make_cells
from sim_core.checks import ConfigError

GRID = SweepConfig(
    methods=("sensor", "out"), robots=(5, 10), groups=(1,), seeds=(1,), baselines=("greedy",), baseline_episodes=500
)


def row_of(grid: SweepConfig, episodes: int = 3000) -> ResultRow:
    """The Fixed row of the grid's first trained cell."""
    config = next(cell for cell in make_cells(grid) if cell.policy == LEARNED).config
    world, counts = config.world, (episodes, 0, 0, 0, 0)
    setup = (world.robots, world.groups)
    hashed = cell_hash(config)
    return ResultRow(grid.label, LEARNED, world.method, *setup, config.seed, *setup, episodes, *counts, 210.0, hashed)


def test_the_example_of_each_method_is_a_cell_that_trains(tmp_path: Path):
    SweepResults(GRID, tmp_path).write()
    examples = json.loads((tmp_path / "settings.json").read_text())["a_cell_of_each_method"]
    assert set(examples) == {"sensor", "out"}
    for example in examples.values():
        assert example["final_eval_episodes"] == GRID.episodes != GRID.baseline_episodes
        assert example["world"]["robots"] == 5


@pytest.mark.parametrize(
    "grid",
    [
        SweepConfig(),
        GRID,
        SweepConfig(preset="best", set=("hidden_sizes=[64, 32]", "apf_rows=all"), baselines=(), env_steps=5_000),
        SweepConfig(first_seed=3_000_000_000, extrapolation="none", episodes=600),
    ],
)
def test_the_recorded_command_gives_the_same_grid(grid: SweepConfig):
    program, *words = shlex.split(sweep_command(grid))
    command = parse(words)
    assert program == "shoal" and isinstance(command, Sweep) and command.grid == grid


def test_provenance_is_kept_and_comes_with_known_results(tmp_path: Path):
    first = SweepResults(GRID, tmp_path / "first")
    first.record_provenance()
    write_table(first.table, [row_of(GRID)])
    before = read_provenance(tmp_path / "first" / "results.csv")
    assert [each.command for each in before] == [sweep_command(GRID)]

    more = SweepConfig(methods=("in",), seeds=(0,))
    for _ in range(2):  # the same command again adds no provenance
        later = SweepResults(more, tmp_path / "later", tmp_path / "first" / "results.csv")
        later.record_provenance()
        later.write()
    known = read_provenance(tmp_path / "later" / "results.csv")
    assert [each.command for each in known] == [sweep_command(GRID), sweep_command(more)]


def test_provenance_of_the_first_format_is_kept(tmp_path: Path):
    older = {"sweep": dataclasses.asdict(GRID), "commit": "a1d63ee"}
    (tmp_path / "settings.json").write_text(json.dumps(older))
    SweepResults(GRID, tmp_path).write()
    assert read_provenance(tmp_path / "results.csv") == [(sweep_command(GRID), "a1d63ee")]


def test_known_results_of_other_settings_are_left_out_with_their_provenance(tmp_path: Path):
    other = dataclasses.replace(GRID, env_steps=250_000)
    first = SweepResults(other, tmp_path / "first")
    first.record_provenance()
    write_table(tmp_path / "first" / "results.csv", [row_of(other)])
    later = SweepResults(GRID, tmp_path / "later", tmp_path / "first" / "results.csv")
    later.write()
    assert later.left_out == 1 and not read_table(tmp_path / "later" / "results.csv")
    assert read_provenance(tmp_path / "later" / "results.csv") == []


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"sittings": [1]}', '{"sittings": {"command": "x"}}'])
def test_an_unreadable_file_gives_no_provenance(text: str, tmp_path: Path):
    (tmp_path / "settings.json").write_text(text)
    assert read_provenance(tmp_path / "results.csv") == []


@pytest.mark.parametrize(
    "other",
    [
        {"env_steps": 250_000},
        {"first_seed": 3_000_000_000},
        {"episodes": 600},
    ],
)
def test_a_folder_with_results_of_other_settings_is_refused_and_unchanged(other: dict[str, int], tmp_path: Path):
    """Otherwise each of these would drop rows of the table silently."""
    write_table(tmp_path / "results.csv", [row_of(GRID)])
    before = (tmp_path / "results.csv").read_bytes()
    for robots in ((5, 10), (15,)):  # whether this sweep has the cell or not
        changed = dataclasses.replace(GRID, robots=robots, **other)
        with pytest.raises(ConfigError, match="5r×1g, seed 1.*--name"):
            SweepResults(changed, tmp_path)
    assert (tmp_path / "results.csv").read_bytes() == before
    SweepResults(GRID, tmp_path).write()
    assert (tmp_path / "results.csv").read_bytes() == before
