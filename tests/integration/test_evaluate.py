"""`shoal evaluate`: baselines and policies, what is stored, and what is refused before anything is played."""

import dataclasses
import os
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from actors.evaluation.evaluation_store import load_evaluation
from actors.evaluation.evaluator import ROBOT_EPISODES_PER_PROCESS, SHORT_PROCESSES, evaluate
from actors.evaluation.trajectory import load_episodes
from actors.policy.baselines import Baseline
from actors.policy.network import QNetwork, snapshot
from actors.rollout.env_spec import EnvSpec
from actors.rollout.vector_env import env_shape
from deploy.cli import main
from deploy.commands import evaluate as playing
from deploy.commands.evaluate import episodes_path
from learner.export.saved_policy import save_policy
from learner.presets import preset_config
from learner.run_folder import RunFolder
from sim_core import ENV_ID
from sim_core.config import WorldConfig
from sim_core.outcomes import Outcome
from tests.integration.conftest import SMALL

FIRST_SEED = 2_000_000_000


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """An empty folder to work in, where evaluation needs no Ray."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        playing, "evaluate_in_tasks", lambda specs, who, seeds, _: [evaluate(s, who, seeds) for s in specs]
    )
    return tmp_path


def make_run(name="r", **changes):
    """A run folder under runs/ that holds a policy and no checkpoint, as a sweep leaves it."""
    config = dataclasses.replace(SMALL, **changes)
    run = RunFolder(Path("runs") / name)
    run.save_config(config)
    shape = env_shape(config.env)
    torch.manual_seed(0)
    network = QNetwork(shape.observation_size, config.hidden_sizes, shape.num_actions)
    save_policy(run.policy, snapshot(network, 77, 0.0))
    return run, config, snapshot(network, 77, 0.0)


def assert_same_stats(stored, expected):
    for first, second in zip(stored, expected, strict=True):
        np.testing.assert_array_equal(first, second)


PLAYED = [
    *((baseline, method) for baseline in Baseline if baseline != "field" for method in ("sensor", "in", "out")),
    (Baseline.FIELD, "in"),
]
"""Baselines with the methods that have them."""


@pytest.mark.parametrize(("baseline", "method"), PLAYED)
def test_a_baseline_is_stored_as_it_was_played(capsys, folder, baseline, method):
    arguments = ["--method", method, "--robots", "4", "--groups", "1", "--episodes", "5", "--out", "new/e.zarr"]
    assert main(["evaluate", str(baseline), *arguments]) == 0
    printed = capsys.readouterr().out
    assert f"{baseline}, {method} 4r×1g: 5 episodes" in printed
    assert "success rate" in printed and "new/e.zarr" in printed
    stored = load_evaluation(folder / "new" / "e.zarr")
    spec = EnvSpec(ENV_ID, WorldConfig(method=method, robots=4, groups=1))
    seeds = list(range(FIRST_SEED, FIRST_SEED + 5))
    assert (stored.spec, stored.candidate, stored.updates) == (spec, str(baseline), 0)
    assert stored.seed.tolist() == seeds
    assert_same_stats(stored.stats, evaluate(spec, baseline, seeds))


def test_a_baseline_plays_in_a_presets_world(folder):
    arguments = ["--preset", "thesis", "--method", "out", "--robots", "5", "--episodes", "4", "--out", "e.zarr"]
    assert main(["evaluate", "greedy", *arguments]) == 0
    assert load_evaluation(folder / "e.zarr").spec.world == preset_config("thesis", "out", 5, 2).world


def test_conditions_hold_alone_whatever_a_policy_was_trained_with(folder):
    trained = dataclasses.replace(SMALL.world, position_loss=0.9, conditions="drawn")
    make_run(world=trained)
    arguments = ["--episodes", "4", "--under", "position_delay_steps=4", "shield=orca", "--out", "e.zarr"]
    assert main(["evaluate", "r", *arguments]) == 0
    stored = load_evaluation(folder / "e.zarr")
    assert stored.spec.world == dataclasses.replace(SMALL.world, position_delay_steps=4, shield="orca")
    assert main(["evaluate", "r", "--episodes", "4", "--out", "trained.zarr"]) == 0
    assert load_evaluation(folder / "trained.zarr").spec.world == trained


def test_a_baseline_plays_the_dissertations_setup_by_default(capsys):
    assert main(["evaluate", "random", "--episodes", "2"]) == 0
    assert "random, sensor 10r×2g: 2 episodes" in capsys.readouterr().out


def test_a_policy_is_stored_as_it_was_played_on_another_setup(capsys, folder):
    _, config, weights = make_run()
    arguments = ["--robots", "4", "--episodes", "5", "--first-seed", "9", "--out", "e.zarr"]
    assert main(["evaluate", "r", *arguments]) == 0
    assert "sensor 4r×2g: 5 greedy episodes" in capsys.readouterr().out
    stored = load_evaluation(folder / "e.zarr")
    spec = config.env._replace(world=dataclasses.replace(config.world, robots=4))
    assert (stored.spec, stored.candidate, stored.updates) == (spec, "r", 77)
    assert_same_stats(stored.stats, evaluate(spec, weights, list(range(9, 14))))


@pytest.mark.parametrize("player", ["r", *(baseline for baseline in Baseline if baseline != "field")])
def test_the_first_episodes_are_recorded_whole(folder, player):
    make_run()
    assert main(["evaluate", player, "--robots", "3", "--episodes", "4", "--record", "2", "--out", "e.zarr"]) == 0
    stored = load_evaluation(folder / "e.zarr")
    episodes, world = load_episodes(folder / "e-episodes.zarr")
    assert world == stored.spec.world
    assert [episode.seed for episode in episodes] == [FIRST_SEED, FIRST_SEED + 1]
    assert [episode.outcome for episode in episodes] == stored.stats.outcome[:2].tolist()
    assert [len(episode.action) - 1 for episode in episodes] == stored.stats.length_steps[:2].tolist()


def test_a_baselines_name_is_taken_and_a_run_of_that_name_is_named_as_a_folder(capsys):
    make_run("greedy")
    assert main(["evaluate", "greedy", "--episodes", "2"]) == 0
    assert "greedy, sensor 10r×2g: 2 episodes" in capsys.readouterr().out
    assert main(["evaluate", "./greedy", "--episodes", "2"]) == 0
    assert "sensor 3r×2g: 2 greedy episodes" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["r", "--under", "position_loss=0,1"], ["position_loss must have one value here"]),
        (["r", "--under", "position_loss=2"], ["position_loss must be between 0 and 1, not 2.0"]),
        (["r", "--under", "horizon_steps=2"], ["'horizon_steps' is no condition"]),
        (["r", "--preset", "best"], ["--preset", "'r' has a preset of its own"]),
        (["r", "--checkpoint", "step-7"], ["no checkpoint 'step-7'", "there are: none"]),
        (
            ["r", "--method", "in"],
            ["--method", "fl-orca, fl-orca-snapped, greedy, field, random", "'r' has a method of its own"],
        ),
        (["field", "--method", "out"], ["method out has no rule field", "fl-orca, fl-orca-snapped, greedy, random"]),
        (["r", "greedy", "--method", "in"], ["--method", "'r' has a method of its own"]),
        (["r", "r"], ["name each player once"]),
        (["r", "random", "--out", "e.zarr"], ["--out", "evaluate it alone"]),
        (["r", "wide"], ["wide and r do not start alike"]),
        (["r", "c"], ["c plays CartPole-v1, whose episodes have no outcomes"]),
        (["several", "--out", "e.zarr"], ["'several' has learned 2", "--robots and --groups"]),
        (["greedy", "--method", "touch"], ["method must be one of", "touch"]),
        (["greedy", "--robots", "1"], ["robots", "at least 2"]),
        (["fl-orca", "--robots", "400"], ["does not fit"]),
        (["random", "--method", "out", "--robots", "2"], ["robots", "at least 3"]),
        (["greedy", "--episodes", "0"], ["--episodes", "1..10000000"]),
        (["greedy", "--first-seed", "-1"], ["--first-seed"]),
        (["greedy", "--record", "1"], ["--record needs --out"]),
        (["greedy", "--record", "-1", "--out", "e.zarr"], ["--record", "0..1000"]),
        (["greedy", "--record", "3", "--episodes", "2", "--out", "e.zarr"], ["--record", "0..2", "3"]),
        (["greedy", "--out", "e.csv"], ["--out", ".zarr", "e.csv"]),
        (["greedy", "--out", ""], ["--out", ".zarr"]),
        (["greedy", "--out", "/proc/nothing/e.zarr"], ["--out", "/proc/nothing", "write"]),
        (["greedy", "--out", "taken.zarr"], ["taken.zarr exists", "not overwritten"]),
        (["greedy", "--out", "half.zarr", "--record", "1"], ["half-episodes.zarr exists", "not overwritten"]),
        (["nobody"], ["nobody", "runs there: c, r"]),
        (["c", "--groups", "3"], ["--groups", "CartPole-v1"]),
        (["c", "--out", "e.zarr", "--record", "1"], ["--record", "CartPole-v1"]),
    ],
)
def test_refused_before_anything_is_played(capsys, folder, monkeypatch, arguments, words):
    def played(*_):
        raise AssertionError("an episode was played")

    make_run()
    make_run("c", env_id="CartPole-v1")
    make_run("wide", world=dataclasses.replace(SMALL.world, arena_radius_m=4.0))
    make_run("several", setups=("3x2", "4x1"))
    (folder / "taken.zarr").mkdir()
    (folder / "half-episodes.zarr").mkdir()
    monkeypatch.setattr(playing, "evaluate_in_tasks", played)
    try:
        code = main(["evaluate", *arguments])
    except SystemExit as stop:  # tyro's way out
        code = stop.code
    error = capsys.readouterr().err
    assert code == 2
    assert "Traceback" not in error
    for word in words:
        assert word in error
    assert sorted(path.name for path in folder.iterdir()) == ["half-episodes.zarr", "runs", "taken.zarr"]


def rates(printed):
    """Rows of a printed table of players: name to the texts of its cells."""
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in printed.splitlines() if "│" in line]
    return [row for row in rows if len(row) == 7]


def test_players_meet_the_same_scenes_and_differ_in_pairs(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    _, config, weights = make_run()
    assert main(["evaluate", "greedy", "r", "fl-orca", "--episodes", "40", "--first-seed", "5"]) == 0
    rows = rates(capsys.readouterr().out)
    seeds, spec = list(range(5, 45)), config.env
    goals = [
        evaluate(spec, player, seeds).outcome == int(Outcome.GOAL)
        for player in (Baseline.GREEDY, weights, Baseline.FL_ORCA)
    ]
    assert [row[1] for row in rows] == ["greedy", "r", "fl-orca"] and rows[0][0] == config.world.setup
    for row, reached in zip(rows, goals, strict=True):
        assert row[2] == f"{100 * reached.mean():.1f} %"
    assert rows[0][4:] == ["", "", ""]
    for row, reached in zip(rows[1:], goals[1:], strict=True):
        assert row[4] == f"{100 * (reached.mean() - goals[0].mean()):+.1f}"
        assert row[6].startswith(f"{(reached & ~goals[0]).sum()} : {(goals[0] & ~reached).sum()}, p = ")


def test_a_policy_of_several_setups_is_evaluated_in_each(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    _, config, weights = make_run(setups=("3x2", "4x1"))
    assert main(["evaluate", "r", "--episodes", "30"]) == 0
    printed = capsys.readouterr().out
    seeds, total = list(range(FIRST_SEED, FIRST_SEED + 30)), 0
    for robots, groups in ((3, 2), (4, 1)):
        spec = EnvSpec(ENV_ID, dataclasses.replace(config.world, robots=robots, groups=groups))
        reached = int((evaluate(spec, weights, seeds).outcome == int(Outcome.GOAL)).sum())
        total += reached
        assert re.search(rf"{robots}r×{groups}g\W+{100 * reached / 30:.1f} %", printed)
    assert "sensor in 2 setups: 60 greedy episodes" in printed
    assert re.search(rf"success rate\W+{100 * total / 60:.1f} %", printed)
    assert main(["evaluate", "r", "greedy", "--episodes", "8"]) == 0
    assert [row[:2] for row in rates(capsys.readouterr().out)] == [
        ["3r×2g", "r"],
        ["", "greedy"],
        ["4r×1g", "r"],
        ["", "greedy"],
    ]
    assert main(["evaluate", "r", "--robots", "5", "--episodes", "3"]) == 0
    assert "sensor 5r×2g: 3 greedy episodes" in capsys.readouterr().out


def test_without_record_older_episodes_are_no_obstacle(folder):
    (folder / "e-episodes.zarr").mkdir()
    assert main(["evaluate", "greedy", "--episodes", "2", "--out", "e.zarr"]) == 0


def test_an_environment_that_is_not_ours_is_stored_too(folder):
    _, config, weights = make_run("c", env_id="CartPole-v1")
    assert main(["evaluate", "c", "--episodes", "3", "--out", "e.zarr"]) == 0
    stored = load_evaluation(folder / "e.zarr")
    assert stored.spec.env_id == "CartPole-v1"
    assert_same_stats(stored.stats, evaluate(config.env, weights, list(range(FIRST_SEED, FIRST_SEED + 3))))


def test_a_damaged_policy_is_refused(capsys):
    run, _, _ = make_run()
    assert load_file(run.policy)
    os.truncate(run.policy, 100)
    assert main(["evaluate", "r"]) == 2
    assert "policy.safetensors" in capsys.readouterr().err


def test_episodes_lie_beside_the_results():
    assert episodes_path(Path("a/b.c.zarr")) == Path("a/b.c-episodes.zarr")


@pytest.mark.ray
def test_over_ray_the_results_are_those_of_one_process(shoal, folder):
    """There are enough episodes that a Ray of its own is worth its start."""
    episodes = SHORT_PROCESSES * ROBOT_EPISODES_PER_PROCESS // 200
    size = ["--robots", "25", "--groups", "8", "--episodes", str(episodes)]
    done = shoal("evaluate", "random", *size, "--out", "e.zarr")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    stored = load_evaluation(folder / "e.zarr")
    assert stored.seed.tolist() == list(range(FIRST_SEED, FIRST_SEED + episodes))
    assert_same_stats(stored.stats, evaluate(stored.spec, Baseline.RANDOM, stored.seed.tolist()))
