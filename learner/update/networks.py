"""The networks of a run, in torch: the one that learns, and the one that acts, without a dueling head."""

from __future__ import annotations

from actors.policy.network import Network, make_network
from actors.rollout.vector_env import EnvShape
from learner.config import RunConfig


def learning_network(config: RunConfig, shape: EnvShape) -> Network:
    """The network that learns."""
    return make_network(
        config.network, shape.observation_size, config.hidden_sizes, shape.num_actions, config.env.row_size
    )


def acting_network(config: RunConfig, shape: EnvShape) -> Network:
    """The network of a saved policy; a dueling one is saved as the plain network that it is equal to."""
    kind = "plain" if config.network == "dueling" else config.network
    return make_network(kind, shape.observation_size, config.policy_sizes, shape.num_actions, config.env.row_size)
