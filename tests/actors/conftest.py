"""Small environments and random policies for the tests of actors."""

import numpy as np
import pytest

from actors.policy.policy import WeightsSnapshot
from actors.rollout.env_spec import EnvSpec
from actors.rollout.vector_env import env_shape
from sim_core import ENV_ID
from sim_core.config import WorldConfig


def _random_weights(spec, hidden_sizes=(16,), seed=0, version=0, time_s=0.0):
    shape = env_shape(spec)
    rng = np.random.default_rng(seed)
    sizes = (shape.observation_size, *hidden_sizes, shape.num_actions)
    arrays = []
    for fan_in, fan_out in zip(sizes[:-1], sizes[1:], strict=True):
        arrays += [rng.normal(size=(fan_out, fan_in)), rng.normal(size=fan_out)]
    return WeightsSnapshot(version, time_s, tuple(array.astype(np.float32) for array in arrays))


@pytest.fixture(scope="session")
def swarm():
    """Spec of the swarm environment with short episodes that end in several ways."""
    return EnvSpec(ENV_ID, WorldConfig(robots=4, groups=2, arena_radius_m=2.0, horizon_steps=25))


@pytest.fixture(scope="session")
def cart_pole():
    """Spec of another environment, which reports no outcomes."""
    return EnvSpec("CartPole-v1", WorldConfig())


@pytest.fixture(scope="session")
def make_weights():
    """Function: a random WeightsSnapshot for a spec; takes hidden_sizes, seed, version, time_s."""
    return _random_weights
