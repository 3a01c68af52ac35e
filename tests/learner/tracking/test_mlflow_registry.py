"""Names of registered models, by MLflow's own rule."""

import pytest
from mlflow.utils.validation import _validate_model_name

from learner.config import RunConfig
from learner.tracking.mlflow_registry import MAX_NAME, model_name

IDS = [
    "CartPole-v1",
    "odd_envs:Plain-v0",
    "a.b.c:name-space/Some.Thing-v12",
    "ALE/Pong-v5",
    "module:ns:x/Env:1.5-v0",
    "m." * 150 + "module:Env-v0",
    "Größe:Ünï-v1",
]


@pytest.mark.parametrize("env_id", IDS)
def test_any_id_of_gymnasium_is_a_legal_name(env_id):
    name = model_name(RunConfig(env_id=env_id))
    _validate_model_name(name)
    assert 0 < len(name) <= MAX_NAME and name[-6:] == env_id[-6:].replace(":", "-").replace("/", "-")
