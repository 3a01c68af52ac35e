"""A user's own Gymnasium environment, named `module:Env-v0`, sound or broken."""

import dataclasses
from pathlib import Path

import mlflow
import pytest

from deploy.cli import main
from deploy.commands import watch
from learner.file_names import ENV_TRACE
from learner.run_folder import RunFolder
from tests.integration.conftest import SMALL, flags

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy:DeprecationWarning"),  # MLflow's own query
]


def test_it_trains_resumes_and_is_registered_in_mlflow(tmp_path):
    config = dataclasses.replace(SMALL, env_id="tests.own_env:Line-v0")
    assert main(["train", "--runs-dir", str(tmp_path), *flags(config)]) == 0
    (path,) = (path.parent for path in tmp_path.glob("*/config.json"))
    assert path.name.startswith("tests.own_env-Line-v0-s0-")
    assert main(["resume", str(path), "--total-env-steps", "7000"]) == 0
    assert main(["evaluate", str(path), "--episodes", "4"]) == 0
    uri = RunFolder(path).identity().tracking_uri
    models = mlflow.MlflowClient(uri).search_registered_models()
    assert [model.name for model in models] == ["tests.own_env-Line-v0"]


def test_a_module_that_is_not_there_is_refused(tmp_path, capsys):
    assert main(["train", "--env-id", "no_such_module:Env-v0", "--runs-dir", str(tmp_path)]) == 2
    assert "env_id 'no_such_module:Env-v0' cannot be made by Gymnasium" in capsys.readouterr().err


RUNS = {
    "Raises": (2, "at its step 30: step() raised RuntimeError: the gripper is stuck (odd_envs.py, line"),
    "NanReward": (2, "at its step 30: step() gave the reward nan, which is not finite in float32"),
    "Leaves": (2, "at its step 30: step() ended the process with exit code 1 (odd_envs.py, line"),
    "Sleeps": (2, "at its step 30: step() has not come back (odd_envs.py, line"),
}
"""Exit code and sentence of runs with environments that play well at first."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Path:
    """A folder of runs, with one MLflow database for all."""
    return tmp_path_factory.mktemp("odd") / "runs"


@pytest.fixture
def train(runs, capsys):
    """Function: trains with an odd environment; gives the exit code, what was printed, the sentence and the folder."""

    def train(name, *more, config=SMALL, **settings):
        config = dataclasses.replace(config, env_id=f"tests.odd_envs:{name}-v0", **settings)
        words = ["--runs-dir", str(runs), "--name", name, *flags(config), *more]
        code = main(["train", *words])
        out, err = capsys.readouterr()
        sentences = [line for line in err.splitlines() if line.startswith("shoal: ")]
        assert "Traceback" not in err and len(sentences) == (code != 0), err
        return code, out, "".join(sentences), RunFolder(runs / name)

    return train


def state_of(folder):
    """Status of the run in MLflow, and the names of all registered models."""
    client = mlflow.MlflowClient(folder.identity().tracking_uri)
    models = {model.name for model in client.search_registered_models()}
    return client.get_run(folder.identity().mlflow_run_id).info.status, models


def test_what_a_rehearsal_finds_leaves_no_run_behind(train):
    code, _, sentence, folder = train("CannotBeMade")
    assert code == 2 and "OSError: no robot at /dev/ttyUSB0 (odd_envs.py, line" in sentence
    trace = folder.path / ENV_TRACE
    assert f"its traceback is in {trace}" in sentence and "no robot at" in trace.read_text()
    assert [path.name for path in folder.path.iterdir()] == [ENV_TRACE]
    assert train("CannotBeMade")[:3] == (code, "", sentence), "the name is still free"
    code, _, sentence, folder = train("WrongShape")
    assert code == 2 and "gave an observation of shape (4,)" in sentence and not folder.path.exists()


@pytest.mark.parametrize("name", RUNS)
def test_what_comes_later_ends_the_run_with_a_sentence(train, name):
    code, words = RUNS[name]
    got, _, sentence, folder = train(name, "--deadline-s", "1")
    assert got == code and f"env_id 'tests.odd_envs:{name}-v0' {words}" in sentence
    assert (f"its traceback is in {folder.path / ENV_TRACE}" in sentence) == (name != "NanReward")
    status, models = state_of(folder)
    assert status == "FAILED" and not any(name in model for model in models)


@pytest.mark.parametrize("name", ["DrawsGrey", "NeverDraws", "OwnOutcome", "Parts"])
def test_what_is_only_unusual_is_trained_to_the_end(train, name, monkeypatch):
    code, out, _, folder = train(name, "--deadline-s", "2")
    assert code == 0 and state_of(folder)[0] == "FINISHED"
    assert len([line for line in out.splitlines() if line.startswith("no animation: ")]) == 1
    monkeypatch.setattr(watch, "DEADLINE_S", 2.0)
    assert main(["watch", str(folder.path), "--format", "mp4"]) == 2


def test_a_run_that_diverges_is_failed_and_registers_nothing(train):
    code, _, sentence, folder = train("Plain", learning_rate=1e30, learning_rate_end=1e30)
    assert code == 1 and "the training has diverged: " in sentence and "at env step " in sentence
    status, models = state_of(folder)
    assert status == "FAILED" and not any("Plain" in model for model in models)


@pytest.mark.ray
def test_over_ray_the_sentence_is_the_same(train):
    code, _, sentence, folder = train("Raises", "--name", "raises-ray", engine="ray")
    assert code == 2 and f"env_id 'tests.odd_envs:Raises-v0' {RUNS['Raises'][1]}" in sentence
    assert "the gripper is stuck" in (folder.path.parent / "raises-ray" / ENV_TRACE).read_text()


@pytest.mark.ray
def test_over_ray_an_environment_that_ends_its_process_is_not_restarted_for_ever(train):
    code, _, sentence, _ = train("Leaves", "--name", "leaves-ray", engine="ray")
    assert code == 1 and "rollout worker 0 died" in sentence and "6 times in a row" in sentence
    assert "env_id 'tests.odd_envs:Leaves-v0' may end its process" in sentence
