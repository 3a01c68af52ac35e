"""A trained policy in a file of its own, which torch can load, too; without torch, which takes a second to import."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as to_bytes

from actors.policy.policy import WeightsSnapshot, blank_weights
from actors.rollout.vector_env import EnvShape
from actors.storage.atomic_write import replacing_file
from actors.storage.permissions import may_not_read
from learner.checkpoints.manifest import CheckpointError
from learner.config import RunConfig

ONLINE = "online."
"""How the names of a saved network's tensors begin."""


def save_policy(path: Path, weights: WeightsSnapshot) -> None:
    """Writes a policy to a file of its own, ready to act; an older one is replaced once the new is whole."""
    tensors = dict(zip(_names(weights), weights.arrays, strict=True))
    with replacing_file(path, sync_first=True) as partial:
        partial.write_bytes(to_bytes(tensors, metadata={"updates": str(weights.version)}))


def read_saved_policy(path: Path, config: RunConfig, shape: EnvShape) -> WeightsSnapshot:
    """The policy that `save_policy` wrote.

    Raises:
      CheckpointError: the file cannot be read, or does not fit a network of `config` on environments of `shape`.
    """
    row_size = config.env.row_size if config.network == "pooled" else 0
    blank = blank_weights(shape.observation_size, config.policy_sizes, shape.num_actions, row_size)
    try:
        with safe_open(str(path), "np") as file:
            updates, names = int((file.metadata() or {})["updates"]), set(file.keys())
            arrays = tuple(file.get_tensor(name) for name in _names(blank) if name in names)
    except PermissionError as error:
        raise CheckpointError(may_not_read(path)) from error
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise CheckpointError(f"the policy {path} cannot be read ({error}); start a new run") from error
    kinds = [[(each.shape, each.dtype) for each in weights] for weights in (arrays, blank.arrays)]
    if len(names) != len(arrays) or kinds[0] != kinds[1]:
        raise unfit(path)
    return WeightsSnapshot(updates, 0.0, arrays, row_size)


def unfit(path: Path) -> CheckpointError:
    """The error of a policy that is that of another network."""
    return CheckpointError(
        f"the policy {path} takes other observations or actions than this setup: name a run whose "
        "hidden_sizes, network, sectors, speed_levels, stop_action and sensor_counts (for M_IN and M_OUT also method "
        "and groups) are those of its config"
    )


def _names(weights: WeightsSnapshot) -> list[str]:
    """The names that the arrays have in torch's network (`actors.policy.network`): only every other module has any."""
    shared = 2 if weights.row_size else 0
    layers = range(0, len(weights.arrays) - 2 * shared, 2)
    rows = [f"rows.{2 * i}" for i in range(shared)]
    prefix = "values.layers." if weights.row_size else "layers."
    modules = chain(rows, (f"{prefix}{i}" for i in layers))
    return [f"{ONLINE}{module}.{kind}" for module in modules for kind in ("weight", "bias")]
