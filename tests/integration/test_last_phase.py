"""The end of a run can be cut anywhere, and `shoal resume` makes the rest of it without any env step."""

import dataclasses
import errno
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import mlflow
import pytest

from actors.evaluation.trajectory import load_episodes
from actors.rollout.node import RolloutNode
from actors.storage.append_file import AppendFile
from deploy.cli import main
from learner.checkpoints.checkpoint import newest_valid
from learner.ray_backend.cluster import leave
from learner.run_end import RunEnd
from learner.run_folder import RunFolder
from learner.sweep.cell import SweepLocation, run_cell
from learner.sweep.grid import Cell, SweepConfig
from learner.tracking.mlflow_run import Tracker
from tests.dying import Killed, Places, writes_seen
from tests.integration.conftest import PATIENCE_S, SMALL, clean_environment, flags
from tests.integration.jobs import Job

pytestmark = pytest.mark.filterwarnings(
    "ignore:The ``noload`` loader strategy:DeprecationWarning"
)  # MLflow's own query
SHORT = dataclasses.replace(SMALL, total_env_steps=2_048, eval_every_env_steps=1_024, log_every_env_steps=512)


def train(folder: Path, *more: str) -> None:
    """Trains run `r`; MLflow keeps a tracking URI for all of this process."""
    place = ["--runs-dir", str(folder), "--name", "r", "--tracking-uri", f"sqlite:///{folder}/mlflow.db"]
    main(["train", *place, *flags(SHORT), *more])


def resume(folder: Path) -> int:
    return main(["resume", "r", "--runs-dir", str(folder)])


def assert_whole(folder: Path, expected: dict[str, float], rows: str) -> None:
    """The run is as one that nothing cut: its status, results, artifacts and policy are there, each once."""
    client = mlflow.MlflowClient(f"sqlite:///{folder}/mlflow.db")
    (run,) = client.search_runs([client.get_experiment_by_name("shoal").experiment_id])
    assert run.info.status == "FINISHED"
    final = {name: value for name, value in run.data.metrics.items() if name.startswith("final/")}
    assert final == expected if run.data.tags["engine"] == "process" else final.keys() == expected.keys()
    for name in ("final/return", "eval/return", "train/epsilon"):
        history = [(metric.step, metric.timestamp) for metric in client.get_metric_history(run.info.run_id, name)]
        assert len(history) == len(set(history)) >= 1
    assert (folder / "r" / "metrics.jsonl").read_text() == rows, "no env step was made again"
    (version,) = client.search_model_versions("name = 'sensor-3r-2g'")
    assert client.get_model_version_by_alias("sensor-3r-2g", "best").version == version.version
    models = client.search_logged_models([run.info.experiment_id])
    assert [(model.model_id, str(model.status)) for model in models] == [(version.source.split("/")[1], "READY")]
    stored = {item.path for item in client.list_artifacts(run.info.run_id)}
    assert stored == {"config.json", "learning_curve.png", "episode.html", "episode.zarr"}
    copy = Path(run.info.artifact_uri)
    assert (copy / "learning_curve.png").read_bytes()[-8:-4] == b"IEND"
    assert len(load_episodes(copy / "episode.zarr")[0]) == 1
    assert not list(folder.rglob("*.part"))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The result's metrics of a run that nothing cut."""
    folder = tmp_path_factory.mktemp("whole")
    train(folder)
    client = mlflow.MlflowClient(f"sqlite:///{folder}/mlflow.db")
    (run,) = client.search_runs([client.get_experiment_by_name("shoal").experiment_id])
    return {name: value for name, value in run.data.metrics.items() if name.startswith("final/")}


def die(*arguments):
    raise Killed


@pytest.fixture
def trained(tmp_path, monkeypatch):
    """The folder of a run that was killed when it had written its last checkpoint; nobody may make an env step."""
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(RunEnd, "begin", die)
        patch.setattr("learner.tracking.mlflow_run.Tracker.end", die)
        train(tmp_path)
    monkeypatch.setattr(RolloutNode, "collect", die)
    monkeypatch.setattr("learner.run.LAST_FLUSH_S", 0.5)
    return tmp_path


def kill_until_done(places: Places, work: Callable[[], object]) -> None:
    """Has processes do the work, each killed at the first place where none was; the last one lives."""
    while True:
        try:
            with places.of_a_process():
                work()
            return
        except Killed:
            pass


def test_a_run_that_is_killed_at_every_place_of_its_end_is_whole(trained, whole, capsys):
    rows, places = (trained / "r" / "metrics.jsonl").read_text(), Places(trained)
    kill_until_done(places, lambda: resume(trained))
    assert len(places.deadly) >= 60
    assert_whole(trained, whole, rows)
    assert "MLflow UI" in capsys.readouterr().out
    assert resume(trained) == 2 and "has finished its 2048 env steps" in capsys.readouterr().err


@pytest.mark.ray
def test_a_run_over_ray_that_is_killed_at_every_place_of_its_end_is_whole(tmp_path, whole, monkeypatch, capsys):
    monkeypatch.setattr("learner.run.LAST_FLUSH_S", 0.5)
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(RunEnd, "evaluate", die)
        patch.setattr("learner.tracking.mlflow_run.Tracker.end", die)
        train(tmp_path, "--engine", "ray")
    leave()
    rows, places = (tmp_path / "r" / "metrics.jsonl").read_text(), Places(tmp_path)
    kill_until_done(places, lambda: resume(tmp_path))
    assert len(places.deadly) >= 60
    assert_whole(tmp_path, whole, rows)


SWEEP = SweepConfig(robots=(3, 4), groups=(2,), seeds=(3,), episodes=8, extrapolation_episodes=4, first_seed=77)


def test_a_cell_that_is_killed_at_every_place_of_its_end_has_the_results_of_a_whole_one(tmp_path, monkeypatch):
    monkeypatch.setattr("learner.run.LAST_FLUSH_S", 0.5)
    uri, config = f"sqlite:///{tmp_path}/mlflow.db", dataclasses.replace(SHORT, final_eval_first_seed=77)
    cell, place = Cell("cut", config), SweepLocation(tmp_path / "s" / "cells", uri, "cells")
    Tracker(uri, "cells", str(tmp_path / "artifacts"))  # as a sweep does; without it they would lie in this folder
    expected = run_cell(SWEEP, cell._replace(key="whole"), place, id).read_text()
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(RunEnd, "begin", die)
        patch.setattr("learner.tracking.mlflow_run.Tracker.end", die)
        run_cell(SWEEP, cell, place, id)
    monkeypatch.setattr(RolloutNode, "collect", die)
    places = Places(tmp_path)
    kill_until_done(places, lambda: run_cell(SWEEP, cell, place, id))
    assert len(places.deadly) >= 60
    folder = RunFolder(place.cells / "cut")
    assert folder.results.read_text() == expected and not folder.checkpoints.exists() and not folder.end.exists()
    client = mlflow.MlflowClient(uri)
    experiment = client.get_experiment_by_name("cells").experiment_id
    (run,) = client.search_runs([experiment], "tags.cell = 'cut'")
    assert run.info.status == "FINISHED"
    assert len(client.get_metric_history(run.info.run_id, "final/success_rate")) == 1
    models = client.search_logged_models([experiment], f"source_run_id = '{run.info.run_id}'")
    assert [str(model.status) for model in models] == ["READY"]
    versions = client.search_model_versions("name = 'sensor-3r-2g'")
    assert [version.run_id for version in versions].count(run.info.run_id) == 1
    assert {item.path for item in client.list_artifacts(run.info.run_id)} == {"results.csv", "policy.safetensors"}


class FullDisk:
    """A disk under a folder that takes no more new files, and nothing in the journal, until it has refused often."""

    def __init__(self, root: Path, refusals: int) -> None:
        self._root, self.refusals, self.is_full = str(root), refusals, False

    def refuse(self, path: str) -> None:
        if self.is_full and path.startswith(self._root) and "mlflow.db" not in path:
            self.refusals -= 1
            self.is_full = self.refusals > 0
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)


@pytest.fixture
def full_disk(tmp_path, monkeypatch):
    """A disk that is full from the third row of the journal on; waiting for it takes no time."""
    disk, rows, write = FullDisk(tmp_path, 40), [], AppendFile._write_held

    def write_held(file):
        rows.append(file)
        disk.is_full |= len(rows) == 3
        disk.refuse(str(file._path))
        write(file)

    monkeypatch.setattr(AppendFile, "_write_held", write_held)
    monkeypatch.setattr("learner.tracking.delivery.FIRST_PAUSE_S", 0.001)
    monkeypatch.setattr("learner.loop.DISK_PAUSE_S", 0.001)
    with writes_seen(disk.refuse):
        yield disk


def test_a_run_whose_disk_fills_waits_and_ends_well_once_there_is_space(full_disk, tmp_path, whole, capsys):
    train(tmp_path)
    said = capsys.readouterr().out
    assert full_disk.refusals == 0 and "cannot grow, the disk is full" in said and "no line is missing" in said
    assert "checkpoint of 2,048 env steps could not be written: OSError: [Errno 28]" in said
    assert_whole(tmp_path, whole, (tmp_path / "r" / "metrics.jsonl").read_text())


def test_a_run_whose_disk_stays_full_says_so_and_is_resumed(full_disk, tmp_path, whole, capsys, monkeypatch):
    full_disk.refusals = 10**9
    with monkeypatch.context() as patch:
        for module in ("learner.loop", "learner.tracking.delivery", "learner.run"):
            patch.setattr(f"{module}.DISK_TIMEOUT_S", 0.01)
        train(tmp_path)
    error = capsys.readouterr().err
    assert error.startswith("shoal: the run is trained, but its end lacks") and error.count("\n") == 1
    assert f"`shoal resume {tmp_path}/r`" in error and "No space left on device" in error
    full_disk.is_full, full_disk.refusals = False, 0
    assert resume(tmp_path) == 0
    assert_whole(tmp_path, whole, (tmp_path / "r" / "metrics.jsonl").read_text())


def the_status(folder: Path) -> str:
    client = mlflow.MlflowClient(f"sqlite:///{folder}/runs/mlflow.db")
    (run,) = client.search_runs([client.get_experiment_by_name("shoal").experiment_id])
    return run.info.status


def signalled(folder: Path, number: int, when: Callable[[Job], object], *command: str) -> tuple[int, str]:
    """Exit code and output of a command that gets a signal once `when` returns."""
    job = Job(folder, *command)
    try:
        when(job)
        job.process.send_signal(number)
        return job.process.wait(PATIENCE_S), job.log.read_text()
    finally:
        job.process.kill()


def said(text: str) -> Callable[[Job], object]:
    return lambda job: job.wait_for(lambda: text in job.log.read_text())


def test_real_signals_from_the_first_env_step_to_the_last_step_of_the_end(tmp_path):
    """A terminal that closes during the training, SIGTERM in the evaluation, kill -9 in the end; then a full output."""
    long = dataclasses.replace(SMALL, total_env_steps=10_000_000, final_eval_episodes=300)
    trains = ("train", "--name", "r", *flags(long))
    code, output = signalled(tmp_path, signal.SIGHUP, lambda job: job.wait_for_checkpoints("r", 1), *trains)
    assert (code, the_status(tmp_path)) == (128 + signal.SIGHUP, "KILLED")
    assert "stopped by SIGHUP at" in output and "checkpoint saved" in output and "resume with: shoal resume" in output
    done = newest_valid(tmp_path / "runs/r/checkpoints")[0].state["env_steps"]
    assert done == int(output.split("stopped by SIGHUP at ")[1].split()[0].replace(",", ""))

    more = ("resume", "r", "--total-env-steps", str(done + 1_000))
    code, output = signalled(tmp_path, signal.SIGTERM, said("training done"), *more)
    assert (code, the_status(tmp_path)) == (128 + signal.SIGTERM, "KILLED")
    assert "stopped by SIGTERM" in output and "resume with: shoal resume" in output and "Traceback" not in output
    rows = (tmp_path / "runs/r/metrics.jsonl").read_text()

    code, _ = signalled(tmp_path, signal.SIGKILL, said("logging curve"), "resume", "r")
    assert (code, the_status(tmp_path)) == (-signal.SIGKILL, "RUNNING")
    with open("/dev/full", "w") as full:
        words = [sys.executable, "-m", "deploy", "resume", "r"]
        env = {**clean_environment(), "PYTHONIOENCODING": "ascii"}
        last = subprocess.run(words, cwd=tmp_path, env=env, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert last.returncode == 0 and last.stderr.count("standard output takes nothing") == 1
    assert the_status(tmp_path) == "FINISHED"
    assert (tmp_path / "runs/r/metrics.jsonl").read_text() == rows, "no env step was made again"
