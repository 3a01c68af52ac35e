"""A run in MLflow that a process of its own writes: what arrives, what dies, and what is left of it."""

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from unittest.mock import Mock

import mlflow
import psutil
import pytest

from actors.rollout.vector_env import env_shape
from learner.tracking.begin_tracking import TrackingStart
from learner.tracking.journal import Row
from learner.tracking.mlflow_run import Tracker
from learner.tracking.tracked_run import TrackingError
from learner.tracking.tracker_process import OPEN, MlflowProcess, TrackerProcess
from learner.update.learner import Learner
from sim_core.checks import ConfigError

# MLflow's own tables use an option that SQLAlchemy 2.1 is going to drop.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy is deprecated")

PATIENCE_S = 60.0
ORPHAN = """
import os
from learner.tracking.tracker_process import MlflowProcess
print(MlflowProcess().pid, flush=True)
os.kill(os.getpid(), 9)
"""


@pytest.fixture
def uri(tmp_path):
    return f"sqlite:///{tmp_path / 'mlflow.db'}"


@contextmanager
def opened(uri, tmp_path):
    with closing(TrackerProcess(MlflowProcess(), uri, "tests", str(tmp_path / "artifacts"))) as tracker:
        tracker.opened()
        yield tracker


def rows(first, last):
    return [Row(100 * i, 1_700_000_000_000 + i, {"a": float(i)}) for i in range(first, last)]


def kill(pid):
    """Kills a process and waits until it is gone."""
    process = psutil.Process(pid)
    process.kill()
    process.wait(PATIENCE_S)


def logged(tracker):
    return [metric.step for metric in mlflow.MlflowClient(tracker.uri).get_metric_history(tracker.run_id, "a")]


def test_a_run_is_whole_though_its_process_is_killed_again_and_again(uri, small_run, tmp_path):
    weights, shape = Learner(small_run, env_shape(small_run.env)).weights(0.0), env_shape(small_run.env)
    (tmp_path / "file.txt").write_text("text")
    with opened(uri, tmp_path) as tracker:
        first = tracker.pid
        tracker.start(small_run)
        tracker.push(rows(0, 3))
        kill(first)
        tracker.push(rows(2, 6))
        second = tracker.pid
        tracker.log_artifact(tmp_path / "file.txt")
        tracker.begin_policy(weights, small_run, shape)
        tracker.log_policy(weights, small_run, shape, 0.5)
        kill(second)
        tracker.log_policy(weights, small_run, shape, 0.5)
        tracker.log_results({"success_rate": 0.5}, 1_700_000_000_000)
        tracker.end("FINISHED")
        third = tracker.pid
        client = mlflow.MlflowClient(uri)
        (run,) = client.search_runs([client.get_experiment_by_name("tests").experiment_id])
        assert tracker.run_id == run.info.run_id and tracker.started_ms == run.info.start_time
        assert tracker.is_finished(run.info.run_id) and run.data.metrics["final/success_rate"] == 0.5
        assert logged(tracker) == [0, 100, 200, 300, 400, 500]
        assert [item.path for item in client.list_artifacts(run.info.run_id)] == ["file.txt"]
        assert len(client.search_model_versions("name = 'sensor-3r-2g'")) == 1
        assert len(client.search_logged_models([run.info.experiment_id])) == 1
    assert len({first, second, third}) == 3 and not psutil.pid_exists(third)


def test_several_calls_may_be_under_way(uri, small_run, tmp_path):
    with opened(uri, tmp_path) as tracker, ThreadPoolExecutor(8) as pool:
        tracker.start(small_run)
        list(pool.map(lambda i: tracker.push(rows(i, i + 1)), range(20)))
        assert sorted(logged(tracker)) == [100 * i for i in range(20)]


def test_errors_come_back(uri, small_run, tmp_path):
    (tmp_path / "mlflow.db").write_text("no database")
    with closing(TrackerProcess(MlflowProcess(), uri, "tests", None)) as tracker:
        with pytest.raises(ConfigError, match=r"cannot be opened .*file is not a database"):
            tracker.opened()
        (tmp_path / "mlflow.db").unlink()
    with opened(uri, tmp_path) as tracker:
        with pytest.raises(ConfigError, match="does not know run 123"):
            tracker.resume("123")
        tracker.start(small_run)
        with pytest.raises(RuntimeError, match="TypeError"):
            tracker.push(None)
        with pytest.raises(OSError):
            tracker.log_artifact(tmp_path / "missing")
        (tmp_path / "mlflow.db").write_text("no database")
        with pytest.raises(TrackingError, match="not a database|malformed"):
            tracker.push(rows(0, 1))


def test_a_process_that_dies_before_the_store_is_open_is_told(uri):
    with closing(TrackerProcess(MlflowProcess(), uri, "tests", None)) as tracker:
        kill(tracker.pid)
        with pytest.raises(ConfigError, match="has died"):
            tracker.opened()


def test_signals_that_stop_a_run_do_not_stop_the_process(uri, small_run, tmp_path):
    with opened(uri, tmp_path) as tracker:
        assert os.getpgid(tracker.pid) == tracker.pid != os.getpgid(0), "a terminal signals the run's group"
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            os.kill(tracker.pid, number)
        before = tracker.pid
        tracker.start(small_run)
        tracker.end("KILLED")
        assert tracker.pid == before


def test_an_interrupt_while_another_process_starts_leaves_none_that_does_not_know_the_run(
    uri, small_run, tmp_path, monkeypatch
):
    with opened(uri, tmp_path) as tracker:
        tracker.start(small_run)
        kill(tracker.pid)
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            begin = MlflowProcess.begin
            interrupt = Mock(side_effect=KeyboardInterrupt)
            patch.setattr(
                MlflowProcess, "begin", lambda self, *call: interrupt() if call[0] == OPEN else begin(self, *call)
            )
            tracker.push(rows(0, 1))
        tracker.push(rows(0, 2))
        tracker.end("KILLED")
        assert logged(tracker) == [0, 100]


def test_the_process_ends_with_the_one_that_started_it():
    """Also while it still imports MLflow."""
    done = subprocess.run([sys.executable, "-c", ORPHAN], capture_output=True, text=True, timeout=PATIENCE_S)
    assert done.returncode == -signal.SIGKILL
    pid, end_s = int(done.stdout), time.monotonic() + PATIENCE_S
    while psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < end_s
        time.sleep(0.02)


def test_where_mlflow_is_loaded_no_process_is_started(uri, tmp_path):
    before = psutil.Process().children()
    with TrackingStart() as start:
        start.open(uri, "tests", str(tmp_path / "artifacts"))
        assert type(start.run()) is Tracker and psutil.Process().children() == before


def test_where_it_is_not_a_process_loads_it_and_ends_with_the_block(uri, tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "mlflow")
    with TrackingStart() as start:
        start.open(uri, "tests", str(tmp_path / "artifacts"))
        run = start.run()
        assert type(run) is TrackerProcess and psutil.pid_exists(run.pid)
    assert not psutil.pid_exists(run.pid)
