"""Small runs and hand-made transitions for the tests of the learner."""

import gymnasium as gym
import numpy as np
import pytest
import torch

from actors.rollout.vector_env import EnvShape
from actors.service.messages import transition_dtype
from learner.config import RunConfig
from sim_core.config import WorldConfig

SHAPE = EnvShape(gym.spaces.Box(-100, 100, (3,), np.float32), 4)
ROW = transition_dtype(SHAPE.observation_space)


def _make_rows(count, seed=0, num_actions=4):
    rng = np.random.default_rng(seed)
    rows = np.zeros(count, ROW)
    rows["reward"] = rng.normal(scale=2, size=count)
    rows["discount"] = rng.choice([0.0, 0.9, 0.81], size=count)
    rows["action"] = rng.integers(num_actions, size=count)
    rows["observation"] = rng.normal(size=(count, 3))
    rows["next_observation"] = rng.normal(size=(count, 3))
    return rows


@pytest.fixture(scope="session", autouse=True)
def one_thread():
    """Torch as LearnerNode sets it: more threads than cores are many times slower."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def make_rows():
    """Function: random packed rows with observations `[3]` from count, seed, num_actions."""
    return _make_rows


@pytest.fixture(scope="session")
def learner_shape():
    """Spaces of an environment with such observations and four actions."""
    return SHAPE


@pytest.fixture(scope="session")
def learner_config():
    """A run whose learner is small."""
    return RunConfig(
        hidden_sizes=(8, 6),
        batch_size=16,
        target_update_interval=3,
        max_gradient_norm=0.25,
        seed=5,
        device="cpu",
    )


@pytest.fixture(scope="session")
def small_run():
    """A run config that differs from the defaults in many places."""
    return RunConfig(
        world=WorldConfig(robots=3, groups=2, sectors=4),
        engine="process",
        total_env_steps=2_000,
        envs_per_worker=4,
        steps_per_block=8,
        replay_capacity=1_000,
        min_replay=100,
        batch_size=16,
        hidden_sizes=(8,),
        seed=3,
    )
