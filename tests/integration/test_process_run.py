"""One process: a run is reproducible from its seed, and a resumed run is the uninterrupted one."""

import dataclasses
import json
import signal
from pathlib import Path

import numpy as np
import pytest
import zarr
from safetensors.numpy import load_file

from deploy.cli import main
from learner.checkpoints.checkpoint import newest_valid
from tests.checkpointing import Silent
from tests.integration.conftest import PATIENCE_S, flags
from tests.integration.jobs import Job
from tests.small_run import OPTIONS, train

pytestmark = pytest.mark.filterwarnings(
    "ignore:The ``noload`` loader strategy:DeprecationWarning"
)  # MLflow's own query
CLOCKED = ("speed/", "system/", "time/", "policy/staleness_s")
"""Metrics that depend on the clock."""


class Listing(Silent):
    def __init__(self):
        self.steps = []

    def checkpoint(self, folder, journal_offset):
        self.steps.append(int(folder.name.removeprefix("step-")))


def final_state(folder: Path):
    """Weights, optimiser, replay, worlds, counters and metrics of a run's last checkpoint."""
    checkpoint, skipped = newest_valid(folder / "checkpoints")
    assert not skipped
    arrays = {}
    for path in sorted(checkpoint.folder.glob("*.safetensors")):
        arrays |= {f"{path.stem}/{name}": array for name, array in load_file(path).items()}
    for path in sorted(
        [
            *checkpoint.folder.glob("*.zarr"),
            *checkpoint.folder.glob("*.zarr/priorities"),
            *checkpoint.folder.glob("*.zarr/frames"),
        ]
    ):
        root = zarr.open_group(str(path), mode="r")
        arrays |= {
            f"{path.relative_to(checkpoint.folder)}/{name}": np.asarray(array[...]) for name, array in root.arrays()
        }
    state = checkpoint.state
    for name in ("incarnation", "journal_offset", "meters"):
        state.pop(name)
    for worker in state["workers"]:
        worker["policy"] = worker["policy"][0]
    for shard in state["learner"]["shards"]:
        shard["newest"] = [[worker, sequence] for worker, _, sequence in shard["newest"]]
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    metrics = [
        (steps, {name: value for name, value in values.items() if not name.startswith(CLOCKED)})
        for steps, _, values in rows
    ]
    return arrays, state, metrics


def same_array(one, two):
    return np.array_equal(one, two, equal_nan=one.dtype.kind == "f")  # robots that have left their world


def assert_same(one, two):
    arrays_1, state_1, metrics_1 = one
    arrays_2, state_2, metrics_2 = two
    assert arrays_1.keys() == arrays_2.keys()
    assert len(arrays_1) > 20
    different = [name for name, array in arrays_1.items() if not same_array(array, arrays_2[name])]
    assert not different
    assert state_1 == state_2
    assert metrics_1 == metrics_2
    assert len(metrics_1) >= 6


def test_two_runs_of_a_seed_are_the_same_bit_for_bit(small, tmp_path):
    train(small, tmp_path / "one")
    train(small, tmp_path / "two")
    assert_same(final_state(tmp_path / "one"), final_state(tmp_path / "two"))


def test_no_checkpoint_is_written_twice(small, tmp_path):
    listing = Listing()
    train(dataclasses.replace(small, checkpoint_every_env_steps=small.total_env_steps // 2), tmp_path, listing)
    assert len(listing.steps) == len(set(listing.steps)) >= 2 and listing.steps[-1] >= small.total_env_steps


@pytest.mark.parametrize("name", OPTIONS)
def test_every_option_changes_what_is_learned(small, tmp_path, name):
    replay = {"replay": "prioritised"} if name.startswith("importance") else {}
    train(dataclasses.replace(small, **replay), tmp_path / "one")
    train(dataclasses.replace(small, **replay, **{name: OPTIONS[name]}), tmp_path / "two")
    one, two = (final_state(tmp_path / folder)[0]["learner/online.layers.0.weight"] for folder in ("one", "two"))
    assert one.shape != two.shape or not np.array_equal(one, two)


def test_another_seed_is_another_run(small, tmp_path):
    train(small, tmp_path / "one")
    train(dataclasses.replace(small, seed=1), tmp_path / "two")
    one, two = final_state(tmp_path / "one")[0], final_state(tmp_path / "two")[0]
    assert not np.array_equal(one["learner/online.layers.0.weight"], two["learner/online.layers.0.weight"])


def resumed_arrays(whole, tmp_path):
    """Trains a run at once and in two halves, which must be the same; names of the arrays of its last checkpoint."""
    train(whole, tmp_path / "whole")
    train(dataclasses.replace(whole, total_env_steps=3_072), tmp_path / "halves")
    train(whole, tmp_path / "halves")
    halves = final_state(tmp_path / "halves")
    assert_same(final_state(tmp_path / "whole"), halves)
    return set(halves[0])


def test_a_resumed_run_of_several_setups_is_the_uninterrupted_one(small, tmp_path):
    world = dataclasses.replace(small.world, decision_interval_steps=4)
    whole = dataclasses.replace(
        small, world=world, setups=("3x2", "4x1:2", "2x3"), policy_average_updates=20, workers=2
    )
    names = resumed_arrays(whole, tmp_path)
    assert {"worker-0/world_0.pos_x", "worker-1/world_2.pos_x", "learner/average.layers.0.weight"} <= names


def test_a_resumed_run_of_a_pooled_network_is_the_uninterrupted_one(small, tmp_path):
    world = dataclasses.replace(small.world, method="out", robots=3, groups=2, group_rows=5)
    taught = {"random_turns": True, "teacher": "greedy"}
    whole = dataclasses.replace(
        small, world=world, setups=("3x2", "4x5"), network="pooled", hidden_sizes=(16, 16), **taught
    )
    names = resumed_arrays(whole, tmp_path)
    assert "learner/online.rows.0.weight" in names


@pytest.mark.parametrize("ended", ["fl-orca", "leave"])
def test_a_resumed_run_of_a_swarm_that_learns_is_the_uninterrupted_one(small, tmp_path, ended):
    world = dataclasses.replace(small.world, learners="1.0", ended_learners=ended, decision_interval_steps=2)
    names = resumed_arrays(dataclasses.replace(small, world=world, n_step=3, workers=2, envs_per_worker=13), tmp_path)
    assert "worker-1/world_outcome" in names
    state = newest_valid(tmp_path / "halves" / "checkpoints")[0].state
    ledger, waiting = state["ledger"], 2 * 12 * 2  # six robots of two worlds a worker, n_step - 1 steps each
    assert state["env_steps"] - waiting <= ledger["produced"] == ledger["stored"] <= state["env_steps"]
    written = {name for _, row in final_state(tmp_path / "halves")[2] for name in row}
    assert {"eval/all_arrive_rate", "eval/segregation", "eval/learner_collision_rate"} <= written


@pytest.mark.parametrize("shards", [1, 3])
def test_a_resumed_run_with_every_option_is_the_uninterrupted_one(small, tmp_path, shards):
    whole = dataclasses.replace(small, replay_shards=shards, workers=2, replay_capacity=4_200, **OPTIONS)
    names = resumed_arrays(whole, tmp_path)
    assert "shard-0.zarr/priorities/priority" in names


@pytest.mark.parametrize("shards", [1, 3])
def test_a_run_resumed_in_a_new_process_is_the_uninterrupted_one(small, shoal, tmp_path, shards):
    whole = dataclasses.replace(small, replay_shards=shards, workers=2, replay_capacity=4_200)
    half = dataclasses.replace(whole, total_env_steps=3_072)
    train(whole, tmp_path / "whole")

    assert main(["train", "--runs-dir", str(tmp_path / "runs"), "--name", "halves", *flags(half)]) == 0
    done = shoal("resume", "halves", "--total-env-steps", str(whole.total_env_steps))
    assert done.returncode == 0, done.stderr
    halves = final_state(tmp_path / "runs" / "halves")
    assert halves[1]["env_steps"] >= 2 * 3_000
    assert_same(final_state(tmp_path / "whole"), halves)


def test_sigterm_saves_and_the_run_goes_on(small, capsys, tmp_path):
    long = dataclasses.replace(small, total_env_steps=10_000_000, final_eval_episodes=2)
    job = Job(tmp_path, "train", "--name", "r", *flags(long))
    try:
        job.wait_for_checkpoints("r", 1)
        job.process.terminate()
        assert job.process.wait(PATIENCE_S) == 128 + signal.SIGTERM, job.log.read_text()
    finally:
        job.process.kill()
    output = job.log.read_text()
    assert "stopped by SIGTERM" in output and "checkpoint saved" in output and "Traceback" not in output
    said = int(output.split("stopped by SIGTERM at ")[1].split()[0].replace(",", ""))
    saved, skipped = newest_valid(tmp_path / "runs/r/checkpoints")
    assert saved.state["env_steps"] == said and not skipped, "the checkpoint is of the moment of the stop"
    assert main(["resume", "r", "--runs-dir", str(tmp_path / "runs"), "--total-env-steps", str(said + 2_000)]) == 0
    assert str(saved.folder) in capsys.readouterr().out
