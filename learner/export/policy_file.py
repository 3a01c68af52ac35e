"""A trained policy read out of a checkpoint, without starting the run."""

from __future__ import annotations

from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from actors.policy.network import Network, snapshot
from actors.policy.policy import WeightsSnapshot
from actors.rollout.vector_env import EnvShape
from actors.storage.uri import fetched, join_location
from learner.checkpoints.checkpoint import Checkpoint
from learner.checkpoints.manifest import damaged
from learner.config import RunConfig
from learner.export.saved_policy import ONLINE, unfit
from learner.update.learner_node import WEIGHTS
from learner.update.networks import learning_network

AVERAGE = "average."
"""How the names of a checkpoint's averaged network begin; where there is one, it is the policy."""


def read_policy(checkpoint: Checkpoint, config: RunConfig, shape: EnvShape) -> WeightsSnapshot:
    """The policy's weights of a checkpoint.

    Raises:
      CheckpointError: the weights do not fit a network of `config` on environments of `shape`.
    """
    updates = checkpoint.state.get("updates")
    if type(updates) is not int:
        raise damaged(checkpoint.folder, "state.json has no number of updates")
    network = learning_network(config, shape)
    with fetched(join_location(checkpoint.folder, WEIGHTS)) as path:
        return _read(path, updates, network)


def _read(path: Path, updates: int, network: Network) -> WeightsSnapshot:
    try:
        network.load_state_dict(_policy(load_file(str(path))))
    except (RuntimeError, OSError, SafetensorError) as error:
        raise unfit(path) from error
    return snapshot(network, updates, 0.0)


def _policy(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    prefix = AVERAGE if any(name.startswith(AVERAGE) for name in tensors) else ONLINE
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
