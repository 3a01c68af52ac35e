"""A run's episodes as MLflow datasets, and its policy in MLflow's model registry.

Each setup has one registered model, such as `sensor-10r-2g`. Its versions are the policies of finished runs; the alias
`best` names the one with the highest score.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from typing import Any

from mlflow import MlflowClient
from mlflow.entities import Dataset, DatasetInput, InputTag, LoggedModel, LoggedModelStatus
from mlflow.entities.model_registry import ModelVersion
from mlflow.exceptions import MlflowException
from mlflow.protos.databricks_pb2 import RESOURCE_ALREADY_EXISTS, ErrorCode
from mlflow.utils.mlflow_tags import MLFLOW_DATASET_CONTEXT

from learner.config import RunConfig, config_hash

BEST = "best"
"""Alias of the version with the highest score."""
MAX_NAME = 200
"""Most characters of a registered model's name; MLflow's database takes 256."""
SCORE = "score"
"""Tag of a version: success rate of the run's final evaluation; mean return where episodes have no outcome."""


POLICY_MODEL = "policy"
"""Name of a run's logged model."""
UPDATES = "updates"
"""Tag of a logged model and of a version: number of updates applied to its weights."""


def model_name(config: RunConfig) -> str:
    """Name of the registered model for a run's setup; MLflow takes neither all characters nor all lengths of an id."""
    world = config.world
    if len(config.env.worlds) > 1:
        return f"{world.method_name}-{len(config.env.worlds)}-setups"
    if config.env.is_swarm:
        return f"{world.method_name}-{world.robots}r-{world.groups}g"
    return re.sub(r"[^\w.-]", "-", config.env_id)[-MAX_NAME:]


def find_policy(client: MlflowClient, experiment_id: str, run_id: str, updates: int) -> LoggedModel | None:
    """The model that a run has logged after `updates` updates; None if there is none. Removes unfinished ones."""
    logged = client.search_logged_models([experiment_id], f"source_run_id = '{run_id}'")
    for model in logged:
        if model.status != LoggedModelStatus.READY:
            client.delete_logged_model(model.model_id)  # a kill has left it
    ready = (model for model in logged if model.status == LoggedModelStatus.READY)
    return next((model for model in ready if model.tags.get(UPDATES) == str(updates)), None)


def register_policy(
    client: MlflowClient, config: RunConfig, run_id: str, updates: int, model_uri: str, score: float
) -> None:
    """Registers a run's logged model as a version of its setup's model, unless that policy of the run has one already.

    Args:
      client: client of the store.
      config: the run's config.
      run_id: id of its MLflow run.
      updates: number of updates applied to the policy's weights.
      model_uri: URI of its logged model.
      score: by which versions are ranked.
    """
    name = model_name(config)
    _ensure_model(client, name)
    versions: list[ModelVersion] = list(client.search_model_versions(f"name = '{name}'"))
    if all((version.run_id, version.tags.get(UPDATES)) != (run_id, str(updates)) for version in versions):
        tags = {SCORE: repr(float(score)), UPDATES: str(updates), "config_hash": config_hash(config)}
        tags["seed"] = str(config.seed)
        model_id = model_uri.rsplit("/", 1)[1]
        versions.append(client.create_model_version(name, model_uri, run_id, tags, model_id=model_id))
    ranked = [version for version in versions if SCORE in version.tags]
    best = max(ranked, key=lambda version: (float(version.tags[SCORE]), -int(version.version)))
    client.set_registered_model_alias(name, BEST, best.version)


def _ensure_model(client: MlflowClient, name: str) -> None:
    try:
        client.create_registered_model(name)
    except MlflowException as error:
        if error.error_code != ErrorCode.Name(RESOURCE_ALREADY_EXISTS):
            raise


def dataset_inputs(config: RunConfig, commit: str) -> list[DatasetInput]:
    """The episodes that a run learns from, and those of its final evaluation, as MLflow datasets.

    Two runs share a dataset if they play the same worlds with the same seeds.

    Args:
      config: the run's config.
      commit: commit of the simulator's code.
    """
    evaluation = {"first_seed": config.final_eval_first_seed, "episodes": config.final_eval_episodes}
    return [
        _dataset(config, commit, "training", {"seed": config.seed, "env_steps": config.total_env_steps}),
        _dataset(config, commit, "evaluation", evaluation),
    ]


def _dataset(config: RunConfig, commit: str, context: str, profile: dict[str, int]) -> DatasetInput:
    plays: dict[str, Any] = dataclasses.asdict(config.world) if config.env.is_swarm else {"env_id": config.env_id}
    if config.setups:
        plays["setups"] = config.setups
    digest = hashlib.sha256(json.dumps(plays | profile, sort_keys=True).encode()).hexdigest()[:8]
    source = json.dumps({"tags": {"mlflow.source.git.commit": commit}})
    dataset = Dataset(model_name(config), digest, "code", source, profile=json.dumps(profile))
    return DatasetInput(dataset, [InputTag(MLFLOW_DATASET_CONTEXT, context)])
