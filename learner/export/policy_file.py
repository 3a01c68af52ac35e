"""A trained policy as a file of its own, or read out of a checkpoint without starting the run."""

from __future__ import annotations

from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file
from safetensors.torch import save as to_bytes
from torch import Tensor

from actors.policy.network import Network, load_snapshot, snapshot
from actors.policy.policy import WeightsSnapshot
from actors.rollout.vector_env import EnvShape
from actors.storage.atomic_write import replacing_file
from actors.storage.permissions import may_not_read
from actors.storage.uri import fetched, join_location
from learner.checkpoints.checkpoint import Checkpoint
from learner.checkpoints.manifest import CheckpointError, damaged
from learner.config import RunConfig
from learner.update.learner_node import WEIGHTS
from learner.update.networks import acting_network, learning_network

AVERAGE, ONLINE = "average.", "online."
"""Networks of a checkpoint; the policy is the average where there is one."""


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


def save_policy(path: Path, weights: WeightsSnapshot, config: RunConfig, shape: EnvShape) -> None:
    """Writes a policy to a file of its own, ready to act; an older one is replaced once the new is whole."""
    network = acting_network(config, shape)
    load_snapshot(network, weights)
    tensors = {f"{ONLINE}{name}": tensor for name, tensor in network.state_dict().items()}
    with replacing_file(path, sync_first=True) as partial:
        partial.write_bytes(to_bytes(tensors, metadata={"updates": str(weights.version)}))


def read_saved_policy(path: Path, config: RunConfig, shape: EnvShape) -> WeightsSnapshot:
    """The policy that `save_policy` wrote.

    Raises:
      CheckpointError: the file cannot be read, or does not fit a network of `config` on environments of `shape`.
    """
    try:
        with safe_open(str(path), "pt") as file:
            updates = int((file.metadata() or {})["updates"])
    except PermissionError as error:
        raise CheckpointError(may_not_read(path)) from error
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise CheckpointError(f"the policy {path} cannot be read ({error}); start a new run") from error
    return _read(path, updates, acting_network(config, shape))


def _read(path: Path, updates: int, network: Network) -> WeightsSnapshot:
    try:
        network.load_state_dict(_policy(load_file(str(path))))
    except (RuntimeError, OSError, SafetensorError) as error:
        raise CheckpointError(
            f"the policy {path} takes other observations or actions than this setup: name a run whose "
            "hidden_sizes, network, sectors, stop_action and sensor_counts (for M_IN and M_OUT also method and groups) "
            "are those of its config"
        ) from error
    return snapshot(network, updates, 0.0)


def _policy(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    prefix = AVERAGE if any(name.startswith(AVERAGE) for name in tensors) else ONLINE
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
