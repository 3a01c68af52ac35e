"""A policy's network as an MLflow model; apart from the rest of MLflow, since it needs torch."""

from __future__ import annotations

import warnings

import mlflow
import mlflow.pytorch
import numpy as np
import torch
from mlflow.models import infer_signature

from actors.policy.network import load_snapshot
from actors.policy.policy import WeightsSnapshot
from actors.rollout.vector_env import EnvShape
from learner.config import RunConfig
from learner.tracking.mlflow_registry import POLICY_MODEL, UPDATES
from learner.update.networks import acting_network


def log_network(run_id: str, weights: WeightsSnapshot, config: RunConfig, shape: EnvShape) -> str:
    """Logs the greedy policy's network to the run `run_id` of the present store; returns the model's URI."""
    network = acting_network(config, shape)
    load_snapshot(network, weights)
    example = np.zeros((2, *shape.observation_space.shape), np.float32)
    with torch.no_grad():
        values = network(torch.from_numpy(example)).numpy()
    with warnings.catch_warnings(), mlflow.start_run(run_id=run_id):
        warnings.simplefilter("ignore")  # MLflow warns about its own schema inference
        logged = mlflow.pytorch.log_model(
            network.eval(),
            name=POLICY_MODEL,
            tags={UPDATES: str(weights.version)},
            signature=infer_signature(example, values),
            input_example=example,
            serialization_format="pt2",
            pip_requirements=[f"torch=={torch.__version__.split('+')[0]}", f"numpy=={np.__version__}"],
        )
    return str(logged.model_uri)
