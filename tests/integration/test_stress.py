"""`shoal stress`: what is played, stored, continued, compared and drawn, and what is refused before."""

import csv
import itertools
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from actors.evaluation.conditions import world_under
from actors.evaluation.evaluation_store import load_evaluation
from actors.evaluation.evaluator import evaluate
from actors.policy.baselines import Baseline
from deploy.cli import main
from deploy.commands import stress
from learner.presets import preset_config
from sim_core.outcomes import Outcome
from tests.integration.test_evaluate import make_run

GRID = ["--vary", "position_loss=0,0.8", "shield=none,orca"]
SETUP = ["--robots", "3", "--groups", "2", "--episodes", "12", "--first-seed", "7"]
SEEDS = list(range(7, 19))
FOLDER = Path("runs/stress/greedy+fl-orca")


@pytest.fixture
def played(monkeypatch):
    """The worlds and players that were asked for; evaluation needs no Ray."""
    asked = []

    def in_this_process(work, seeds, address):
        for spec, candidate in work:
            asked.append((spec.world, candidate))
            yield evaluate(spec, candidate, seeds)

    monkeypatch.setattr(stress, "evaluate_each", in_this_process)
    return asked


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """An empty folder to work in, and a wide terminal."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")


def rows_of(printed):
    """Cells of the printed table of success rates."""
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in printed.splitlines() if "│" in line]
    return [row for row in rows if len(row) == 7]


def test_every_player_meets_every_condition_on_the_same_scenes(played, capsys):
    assert main(["stress", "greedy", "fl-orca", "--preset", "best", "--method", "out", *SETUP, *GRID]) == 0
    printed = capsys.readouterr().out
    world = preset_config("best", "out", 3, 2).world
    conditions = [{"position_loss": p, "shield": s} for p, s in itertools.product((0.0, 0.8), ("none", "orca"))]
    pairs = itertools.product(conditions, (Baseline.GREEDY, Baseline.FL_ORCA))
    expected = [(world_under(world, condition), player) for condition, player in pairs]
    assert played == expected
    stored = [load_evaluation(path) for path in FOLDER.glob("*.zarr")]
    assert len(stored) == 8 and all(one.seed.tolist() == SEEDS for one in stored)
    goals = {}
    for one in stored:
        key = (one.spec.world.position_loss, one.spec.world.shield, one.candidate)
        goals[key] = one.stats.outcome == int(Outcome.GOAL)
    rows = rows_of(printed)
    assert [row[3] for row in rows] == ["greedy", "fl-orca"] * 4
    for row, (condition, player) in zip(rows, itertools.product(conditions, ("greedy", "fl-orca")), strict=True):
        own = goals[condition["position_loss"], condition["shield"], player]
        first, clean = goals[condition["position_loss"], condition["shield"], "greedy"], goals[0.0, "none", player]
        assert row[4].startswith(f"{100 * own.mean():.1f} % (")
        assert row[5].split(" ")[0] == (f"{100 * (own.mean() - first.mean()):+.1f}" if player == "fl-orca" else "")
        is_first = condition == conditions[0]
        assert row[6].split(" ")[0] == ("" if is_first else f"{100 * (own.mean() - clean.mean()):+.1f}")
    with (FOLDER / "results.csv").open() as file:
        table = list(csv.DictReader(file))
    for line in table:
        reached = goals[float(line["position_loss"]), line["shield"], line["player"]]
        assert int(line["goal"]) == reached.sum() and int(line["episodes"]) == 12 and line["setup"] == "3r×2g"
        assert sum(int(line[name]) for name in ("goal", "lost", "captured", "collision", "timeout")) == 12
    with Image.open(FOLDER / "curves.png") as image:
        colours = np.asarray(image.convert("RGB")).reshape(-1, 3)
    assert {(0, 114, 178), (213, 94, 0)} <= set(map(tuple, colours.tolist()))


def test_the_same_command_plays_what_is_missing(played, capsys):
    command = ["stress", "greedy", "fl-orca", *SETUP, *GRID]
    assert main(command) == 0
    printed = capsys.readouterr().out
    table = (FOLDER / "results.csv").read_text()
    played.clear()
    assert main(command) == 0
    assert not played and rows_of(capsys.readouterr().out) == rows_of(printed)
    shutil.rmtree(sorted(FOLDER.glob("*.zarr"))[3])
    assert main(command) == 0
    assert len(played) == 1 and "7 of 8 evaluations are there" in capsys.readouterr().out
    assert (FOLDER / "results.csv").read_text() == table
    played.clear()
    assert main([*command[:-1], "shield=none"]) == 0  # a part of the grid
    assert not played
    assert main([*command, "--first-seed", "8"]) == 0
    assert len(played) == 8


def test_a_policy_is_played_as_it_is_now(played, capsys):
    run, config, weights = make_run(world=preset_config("best", "sensor", 3, 2).world)
    command = ["stress", "r", "greedy", "--vary", "command_delay_steps=0,3", "--episodes", "4"]
    assert main(command) == 0
    assert len(played) == 4 and played[0][0] == config.world
    np.testing.assert_array_equal(played[0][1].arrays[0], weights.arrays[0])
    assert "where success falls to 50 %" in capsys.readouterr().out
    shutil.rmtree(run.path)
    make_run(world=config.world, hidden_sizes=(8,))
    played.clear()
    assert main(command) == 0
    assert [player for _, player in played] != [] and all(player != Baseline.GREEDY for _, player in played)


def test_a_damaged_result_is_named(played, capsys):
    command = ["stress", "greedy", "--vary", "position_loss=0", "--episodes", "3"]
    assert main(command) == 0
    (store,) = Path("runs/stress/greedy").glob("*.zarr")
    shutil.rmtree(store / "outcome", ignore_errors=True)
    for path in store.rglob("c/0"):
        path.write_bytes(b"no")
    capsys.readouterr()
    assert main(command) == 2
    assert f"remove {store}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["greedy", "--vary", "position_loss=0,2"], ["position_loss must be between 0 and 1, not 2.0"]),
        (["greedy", "--vary", "position_delay_steps=-1"], ["position_delay_steps must be between 0 and 10, not -1"]),
        (["greedy", "--vary", "dropped_mates=0,99"], ["dropped_mates must be between 0 and 9"]),
        (["greedy", "--vary", "sensing_range_m=0,0.1"], ["sensing_range_m must be 0", "not 0.1"]),
        (["greedy", "--vary", "shield=wood"], ["shield must be one of: none, orca"]),
        (["greedy", "--vary", "turn_rate_limit_deg_s=45,90"], ["add --vary kinematics=unicycle"]),
        (["greedy", "--vary", "position_loss=0,0.5", "burst_steps=2,20"], ["add --vary burst_loss=0.3"]),
        (["greedy", "--vary", "speed=1"], ["'speed' is no condition"]),
        (["greedy", "--vary", "position_loss=0", "position_loss=1"], ["name each axis once"]),
        (["greedy", "--name", "a/b"], ["--name must be a plain folder name"]),
        (["greedy", "greedy"], ["name each player once"]),
        (["nobody"], ["nobody"]),
    ],
)
def test_bad_input_is_refused_before_anything_is_played(played, capsys, arguments, words):
    assert main(["stress", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and all(word in error for word in words)
    assert not played and not Path("runs/stress").exists()
