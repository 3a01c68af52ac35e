"""Over Ray: a run trains, survives being killed and interrupted, and leaves a whole history in MLflow."""

import dataclasses
import json
import signal
from collections import Counter
from pathlib import Path

import mlflow
import numpy as np
import psutil
import pytest
import zarr
from safetensors.numpy import load_file

from learner.checkpoints.checkpoint import Checkpoint, newest_valid
from learner.config import RunConfig, flat_params, to_dict
from learner.ray_backend.cluster import COLLECTS_IN_FLIGHT, PUSHES_IN_FLIGHT
from tests.integration.conftest import PATIENCE_S, SMALL, flags, run_here
from tests.integration.jobs import Job

pytestmark = [
    pytest.mark.ray,
    pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy:DeprecationWarning"),  # MLflow's own query
]

LONG = dataclasses.replace(SMALL, engine="ray", total_env_steps=400_000, checkpoint_every_env_steps=4_000)


def location(folder: Path) -> list[str]:
    """The flags of a run `r` in a folder; MLflow keeps a tracking URI for all of this process."""
    return ["--runs-dir", f"{folder}/runs", "--name", "r", "--tracking-uri", f"sqlite:///{folder}/runs/mlflow.db"]


def the_run(folder: Path):
    client = mlflow.MlflowClient(f"sqlite:///{folder}/runs/mlflow.db")
    runs = client.search_runs([client.get_experiment_by_name("shoal").experiment_id])
    assert len(runs) == 1, "a resumed run is the same MLflow run"
    return client, runs[0]


def assert_history_is_the_journal(folder: Path, run: str) -> None:
    """Every journal row is in MLflow once, and nothing else is."""
    client, found = the_run(folder)
    rows = [json.loads(line) for line in (folder / "runs" / run / "metrics.jsonl").read_text().splitlines()]
    for key in ("train/epsilon", "replay/samples_per_insert", "eval/success_rate"):
        expected = [(steps, values[key]) for steps, _, values in rows if key in values]
        history = [(metric.step, metric.value) for metric in client.get_metric_history(found.info.run_id, key)]
        assert Counter(history) == Counter(expected)
        assert len({steps for steps, _ in history}) == len(history), "a step stands twice"
        assert len(history) >= (1 if key.startswith("eval/") else 2)  # a checkpoint that is due holds up the next one


SPREAD = dataclasses.replace(SMALL, engine="ray", workers=2, replay_shards=2, replay_placement="actors")


@pytest.fixture(scope="class")
def finished(tmp_path_factory: pytest.TempPathFactory):
    """(folder, output of the command) of a run with two workers and two shards of their own."""
    folder = tmp_path_factory.mktemp("finished")
    return folder, run_here("train", *location(folder), *flags(SPREAD))


class TestAFinishedRun:
    def test_a_run_over_ray_leaves_everything_a_user_compares(self, finished):
        folder, output = finished
        for word in ("success rate", "MLflow UI", "checkpoint", "curve", "animation"):
            assert word in output
        client, run = the_run(folder)
        assert run.info.status == "FINISHED"
        assert run.info.run_name == "sensor 3r×2g s0"
        assert run.data.params == {key: str(value) for key, value in flat_params(SPREAD).items()}
        tags = {name: run.data.tags[name] for name in ("method", "robots", "groups", "seed", "engine")}
        assert tags == {"method": "sensor", "robots": "3", "groups": "2", "seed": "0", "engine": "ray"}
        assert len(run.data.tags["mlflow.source.git.commit"]) in (40, len("unknown"))
        assert len(run.data.metrics) < 30
        for key in (
            "final/success_rate_low",
            "train/q_mean",
            "time/learner_waits",
            "time/worker_waits",
            "policy/staleness_updates",
            "eval/return",
        ):
            assert key in run.data.metrics
        artifacts = {item.path for item in client.list_artifacts(run.info.run_id)}
        assert artifacts == {"config.json", "learning_curve.png", "episode.html", "episode.zarr"}
        models = client.search_logged_models([run.info.experiment_id])
        assert [model.source_run_id for model in models] == [run.info.run_id]
        assert_history_is_the_journal(folder, "r")
        assert json.loads((folder / "runs/r/config.json").read_text()) == json.loads(json.dumps(to_dict(SPREAD)))

    def test_every_transition_is_accounted_for(self, finished):
        folder, _ = finished
        assert_transitions_are_accounted_for(newest_valid(folder / "runs/r/checkpoints")[0], SPREAD)


def test_every_transition_of_prioritised_replay_is_accounted_for(tmp_path):
    config = dataclasses.replace(SPREAD, replay="prioritised", network="dueling")
    run_here("train", *location(tmp_path), *flags(config))
    checkpoint, _ = newest_valid(tmp_path / "runs/r/checkpoints")
    assert_transitions_are_accounted_for(checkpoint, config)
    assert_priorities_came_back(checkpoint.folder, checkpoint.state["learner"]["shards"])


def assert_transitions_are_accounted_for(checkpoint: Checkpoint, config: RunConfig) -> None:
    """Every transition that the workers made is in a shard or still in a worker, and samples keep the pace."""
    state = checkpoint.state
    shards = state["learner"]["shards"]
    waiting = [load_file(checkpoint.folder / f"worker-{i}.safetensors")["nstep_waits"].sum() for i in range(2)]
    assert sum(shard["inserted"] for shard in shards) == state["pacing"]["inserted"]
    assert state["pacing"]["inserted"] + sum(waiting) == state["env_steps"]
    assert all(shard["inserted"] > 0 and shard["dropped"] == 0 for shard in shards)
    round_env_steps = config.workers * config.block_env_steps
    assert config.total_env_steps <= state["env_steps"] < config.total_env_steps + round_env_steps
    assert state["pacing"]["sampled"] == state["updates"] * config.batch_size
    ahead = state["pacing"]["inserted"] * config.samples_per_insert - state["pacing"]["sampled"]
    blocks = config.workers * (COLLECTS_IN_FLIGHT + PUSHES_IN_FLIGHT)
    band = 2 * config.batch_size * config.updates_per_call + blocks * config.block_env_steps * config.samples_per_insert
    assert 0 <= ahead - config.min_replay * config.samples_per_insert <= band


def assert_priorities_came_back(folder: Path, shards: list) -> None:
    """The learner's answers reached the Ray actors that the rows are in."""
    for i, shard in enumerate(shards):
        rows = zarr.open_group(str(folder / f"shard-{i}.zarr" / "priorities"), mode="r")
        priorities = np.asarray(rows["priority"][...])
        assert len(priorities) == shard["size"] and 0 < priorities.max() <= shard["largest_priority"]
        assert len(np.unique(priorities)) > 100


def test_kill_9_of_the_whole_job_costs_only_what_came_after_the_last_checkpoint(tmp_path):
    job = Job(tmp_path, "train", "--name", "r", *flags(LONG))
    try:
        job.wait_for_checkpoints("r", 3)
        assert job.listening() == {"127.0.0.1"}, "a Ray of our own is for nobody else"
    finally:
        job.kill_all()
    _, run = the_run(tmp_path)
    assert run.info.status == "RUNNING", "nobody could say that it ended"
    before, _ = newest_valid(tmp_path / "runs/r/checkpoints")
    end = before.state["env_steps"] + 8_000
    assert str(before.folder) in run_here("resume", str(tmp_path / "runs/r"), "--total-env-steps", str(end))
    after, _ = newest_valid(tmp_path / "runs/r/checkpoints")
    assert end <= after.state["env_steps"] < end + 8_000
    assert after.state["updates"] > before.state["updates"]
    assert the_run(tmp_path)[1].info.status == "FINISHED"
    assert_history_is_the_journal(tmp_path, "r")


def test_ctrl_c_saves_and_says_how_to_go_on(tmp_path):
    job = Job(tmp_path, "train", "--name", "r", *flags(LONG))
    try:
        job.wait_for_checkpoints("r", 1)
        for process in psutil.Process(job.process.pid).children(recursive=True):
            process.send_signal(signal.SIGHUP)  # as a terminal that closes; the driver needs them for a checkpoint
        job.process.send_signal(signal.SIGINT)
        assert job.process.wait(PATIENCE_S) == 128 + signal.SIGINT, job.log.read_text()
    finally:
        if job.process.poll() is None:
            job.kill_all()
    output = job.log.read_text()
    assert "stopped by SIGINT" in output
    assert f"shoal resume {tmp_path}/runs/r" in output
    assert "Traceback" not in output and not (tmp_path / "runs/r/faults.jsonl").exists()
    assert the_run(tmp_path)[1].info.status == "KILLED"
    saved, skipped = newest_valid(tmp_path / "runs/r/checkpoints")
    assert not skipped
    said = int(output.split("stopped by SIGINT at ")[1].split()[0].replace(",", ""))
    assert saved.state["env_steps"] == said, "the checkpoint is of the moment of the stop"
    run_here("resume", str(tmp_path / "runs/r"), "--total-env-steps", str(said + 4_000))
    assert the_run(tmp_path)[1].info.status == "FINISHED"
    assert_history_is_the_journal(tmp_path, "r")
