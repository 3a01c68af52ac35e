"""A user's own Gymnasium environment, named `module:Env-v0`."""

import dataclasses

import mlflow
import pytest

from deploy.cli import main
from learner.run_folder import RunFolder
from tests.integration.conftest import SMALL, flags

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy:DeprecationWarning"),  # MLflow's own query
]


def test_it_trains_resumes_and_is_registered_in_mlflow(tmp_path, monkeypatch):
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)  # MLflow sets it when a run of this process logs a model
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
