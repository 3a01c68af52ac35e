"""`shoal train --or-resume`: the same command whether the run is new, was killed at any moment, or has finished."""

import shutil
from pathlib import Path

import mlflow
import pytest

from deploy.cli import main
from learner.checkpoint import newest_valid
from tests.integration.conftest import SMALL, flags

pytestmark = pytest.mark.filterwarnings(
    "ignore:The ``noload`` loader strategy:DeprecationWarning"
)  # MLflow's own query


def train(runs: Path, *more: str) -> int:
    return main(["train", "--runs-dir", str(runs), "--name", "r", "--or-resume", "True", *flags(SMALL), *more])


def the_run(runs: Path):
    client = mlflow.MlflowClient(f"sqlite:///{runs}/mlflow.db")
    (run,) = client.search_runs([client.get_experiment_by_name("shoal").experiment_id])
    return client, run


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The runs folder of a run that `--or-resume` began and ended."""
    runs = tmp_path_factory.mktemp("or") / "runs"
    assert train(runs) == 0
    assert the_run(runs)[1].info.status == "FINISHED"
    return runs


@pytest.fixture
def runs(finished: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage; MLflow knows its run as killed."""
    copy = Path(shutil.copytree(finished, tmp_path / "runs"))
    identity = copy / "r" / "run.json"
    identity.write_text(identity.read_text().replace(str(finished), str(copy)))
    client, run = the_run(copy)
    client.set_terminated(run.info.run_id, "KILLED")
    return copy


def test_a_finished_run_is_left_as_it_is(finished, capsys):
    _, before = the_run(finished)
    assert train(finished) == 0
    assert "has finished before" in capsys.readouterr().out
    _, after = the_run(finished)
    assert after.data.tags == before.data.tags and after.info.end_time == before.info.end_time


def test_a_finished_run_trains_on_where_more_is_asked_for(finished, tmp_path):
    copy = Path(shutil.copytree(finished, tmp_path / "runs"))
    assert train(copy, "--total-env-steps", "8000") == 0
    assert newest_valid(copy / "r" / "checkpoints")[0].state["env_steps"] >= 8_000


def test_a_run_killed_in_its_last_evaluation_is_evaluated(runs, finished):
    _, expected = the_run(finished)
    assert train(runs) == 0
    _, run = the_run(runs)
    assert (run.info.status, run.data.tags["attempts"]) == ("FINISHED", "2")
    assert run.data.metrics["final/return"] == expected.data.metrics["final/return"]


def test_a_run_killed_before_its_first_checkpoint_begins_again(runs, finished):
    shutil.rmtree(runs / "r" / "checkpoints")
    (runs / "r" / "checkpoints" / "step-000000002048.part").mkdir(parents=True)
    assert train(runs) == 0
    _, expected = the_run(finished)
    _, run = the_run(runs)
    assert run.info.status == "FINISHED"
    assert run.data.metrics["final/return"] == expected.data.metrics["final/return"], "one process is reproducible"


def test_a_run_killed_before_it_was_logged_begins_again(runs):
    (runs / "r" / "run.json").unlink()
    (runs / "mlflow.db").unlink()
    shutil.rmtree(runs / "r" / "checkpoints")
    assert train(runs) == 0
    assert the_run(runs)[1].info.status == "FINISHED"


def test_a_run_of_other_settings_and_a_missing_name_are_refused(finished, tmp_path, capsys):
    assert train(finished, "--learning-rate", "0.5") == 2
    assert "other settings" in capsys.readouterr().err
    assert main(["train", "--or-resume", "True", "--runs-dir", str(tmp_path)]) == 2
    assert "--or-resume needs --name" in capsys.readouterr().err
