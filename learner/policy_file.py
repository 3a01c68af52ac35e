"""Reading a trained policy out of a checkpoint, without starting the run."""

from __future__ import annotations

from safetensors import SafetensorError
from safetensors.torch import load_file

from actors.network import QNetwork, WeightsSnapshot, snapshot
from actors.vector_env import EnvShape
from learner.checkpoint import Checkpoint, CheckpointError
from learner.config import RunConfig

ONLINE = "online."


def read_policy(checkpoint: Checkpoint, config: RunConfig, shape: EnvShape) -> WeightsSnapshot:
    """The online network's weights of a checkpoint.

    Raises:
      CheckpointError: the weights do not fit a network of `config` on environments of `shape`.
    """
    network = QNetwork(shape.observation_size, config.hidden_sizes, shape.num_actions)
    try:
        tensors = load_file(str(checkpoint.folder / "learner.safetensors"))
        online = {name.removeprefix(ONLINE): tensor for name, tensor in tensors.items() if name.startswith(ONLINE)}
        network.load_state_dict(online)
    except (RuntimeError, OSError, SafetensorError) as error:
        raise CheckpointError(
            f"the policy of {checkpoint.folder} takes other observations or actions than this setup: name a run whose "
            "sectors, stop_action and hidden_sizes (for M_IN and M_OUT also method and groups) are those of its config"
        ) from error
    return snapshot(network, checkpoint.state["updates"], 0.0)
