"""Faults from outside: an MLflow server that goes away and comes back, and a run under a schedule of kills."""

import dataclasses
import re

import mlflow
import pytest

from deploy.chaos.invariants import broken_invariants
from deploy.chaos.processes import TrackingServer
from deploy.cli import main
from learner.run_folder import RunFolder
from learner.tracking.journal import PushedMark
from tests.integration.conftest import PATIENCE_S, SMALL, flags
from tests.integration.jobs import Job

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy:DeprecationWarning"),  # MLflow's own query
]


@pytest.fixture
def server(tmp_path):
    made = TrackingServer(tmp_path)
    made.start()
    made.wait()
    yield made
    made.kill()


def test_metrics_of_an_outage_of_mlflow_arrive_later_and_once(server, tmp_path):
    config = dataclasses.replace(SMALL, total_env_steps=30_000)
    job = Job(tmp_path, "train", "--name", "r", "--tracking-uri", server.uri, *flags(config))
    folder = RunFolder(tmp_path / "runs" / "r")
    try:
        job.wait_for(lambda: PushedMark.value(folder.pushed) > 0)
        server.kill()
        delivered = PushedMark.value(folder.pushed)
        job.wait_for(lambda: "training done" in job.log.read_text())  # nobody waited for the server
        assert PushedMark.value(folder.pushed) == delivered < folder.journal.stat().st_size
        job.wait_for(lambda: "MLflow does not take the metrics" in job.log.read_text())  # its client has tried
        server.start()
        assert job.process.wait(PATIENCE_S) == 0, job.log.read_text()
    finally:
        if job.process.poll() is None:
            job.process.kill()
            job.process.wait()
    version = mlflow.MlflowClient(server.uri).get_model_version_by_alias("sensor-3r-2g", "best")
    assert version.run_id == folder.identity().mlflow_run_id
    output = job.log.read_text()
    assert "MLflow did not take" not in output.split("MLflow takes the metrics again")[1], "a server refuses nothing"
    assert "MLflow does not take the metrics, they are kept and sent again" in output
    assert "MLflow takes the metrics again; none is missing" in output
    assert "Traceback" not in output
    assert broken_invariants(folder) == []


@pytest.mark.ray
def test_a_run_reaches_its_target_whatever_is_killed(shoal):
    schedule = ("--env-steps", "400000", "--faults", "4", "--every-s", "2", "--seed", "1")
    done = shoal("chaos", "--out", "chaos", *schedule)
    assert done.returncode == 0, done.stdout + done.stderr
    end = re.search(r"(\d+) faults; target reached, accounts balance, MLflow has every row once", done.stdout)
    assert end and int(end[1]) >= 2, done.stdout  # a fast machine may be done before the fourth
    learned = re.search(r"success rate ([\d.]+) % \(", done.stdout)
    assert learned and float(learned[1]) > 40, done.stdout  # undisturbed, 72 to 83 after three quarters


def test_a_used_folder_is_refused(tmp_path, capsys):
    (tmp_path / "chaos" / "run").mkdir(parents=True)
    assert main(["chaos", "--out", str(tmp_path / "chaos")]) == 2
    assert "name another --out" in capsys.readouterr().err
