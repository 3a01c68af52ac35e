"""`shoal train --or-resume`: the same command whether the run is new, was killed at any moment, or has finished."""

import shutil
from pathlib import Path

import mlflow
import pytest

from deploy.cli import main
from learner.checkpoints.checkpoint import newest_valid
from tests.integration.conftest import SMALL, flags

pytestmark = pytest.mark.filterwarnings(
    "ignore:The ``noload`` loader strategy:DeprecationWarning"
)  # MLflow's own query


def train(runs: Path, *more: str) -> int:
    place = ["--runs-dir", str(runs), "--tracking-uri", f"sqlite:///{runs}/mlflow.db"]  # MLflow keeps one by itself
    return main(["train", *place, "--name", "r", "--or-resume", "True", *flags(SMALL), *more])


def all_runs(runs: Path):
    client = mlflow.MlflowClient(f"sqlite:///{runs}/mlflow.db")
    return client.search_runs([client.get_experiment_by_name("shoal").experiment_id])


def the_run(runs: Path):
    (run,) = all_runs(runs)
    return mlflow.MlflowClient(f"sqlite:///{runs}/mlflow.db"), run


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The runs folder of a run that `--or-resume` began and ended."""
    runs = tmp_path_factory.mktemp("or") / "runs"
    assert train(runs) == 0
    assert the_run(runs)[1].info.status == "FINISHED"
    return runs


@pytest.fixture
def copied(finished: Path, tmp_path: Path) -> Path:
    """A copy that a test may change, logged to a database of its own."""
    copy = Path(shutil.copytree(finished, tmp_path / "runs"))
    identity = copy / "r" / "run.json"
    identity.write_text(identity.read_text().replace(str(finished), str(copy)))
    return copy


@pytest.fixture
def runs(copied: Path) -> Path:
    """A copy whose run was killed once its last checkpoint was written."""
    client, run = the_run(copied)
    client.set_terminated(run.info.run_id, "KILLED")
    shutil.rmtree(copied / "r" / "end")
    return copied


def test_a_finished_run_is_left_as_it_is(finished, capsys):
    _, before = the_run(finished)
    assert train(finished) == 0
    assert "has finished before" in capsys.readouterr().out
    _, after = the_run(finished)
    assert after.data.tags == before.data.tags and after.info.end_time == before.info.end_time


def test_a_finished_run_trains_on_where_more_is_asked_for(copied):
    assert train(copied, "--total-env-steps", "8000") == 0
    assert newest_valid(copied / "r" / "checkpoints")[0].state["env_steps"] >= 8_000


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
    (runs / "r" / "run.json").unlink()  # so its MLflow run cannot be found again
    shutil.rmtree(runs / "r" / "checkpoints")
    assert train(runs) == 0
    assert sorted(run.info.status for run in all_runs(runs)) == ["FINISHED", "KILLED"]


def test_a_run_of_other_settings_and_a_missing_name_are_refused(finished, tmp_path, capsys):
    assert train(finished, "--learning-rate", "0.5") == 2
    assert "other settings" in capsys.readouterr().err
    assert main(["train", "--or-resume", "True", "--runs-dir", str(tmp_path)]) == 2
    assert "--or-resume needs --name" in capsys.readouterr().err


def test_checkpoints_stay_where_the_run_has_them(finished, tmp_path, capsys):
    assert train(finished, "--checkpoint-url", str(tmp_path / "elsewhere")) == 2
    error = capsys.readouterr().err
    assert f"has its checkpoints at {finished / 'r' / 'checkpoints'}" in error and "leave out --checkpoint-url" in error
    assert not (tmp_path / "elsewhere").exists()
