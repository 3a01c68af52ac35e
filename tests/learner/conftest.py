"""Small runs and hand-made transitions for the tests of the learner."""

import gymnasium as gym
import numpy as np
import pytest
import torch

from actors.service.messages import transition_dtype
from learner.config import RunConfig
from learner.update.updates import LearnerSettings
from sim_core.config import WorldConfig

ROW = transition_dtype(gym.spaces.Box(-100, 100, (3,), np.float32))


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
def learner_settings():
    """Settings of a small learner for such rows."""
    return LearnerSettings(
        observation_size=3,
        num_actions=4,
        hidden_sizes=(8, 6),
        double=True,
        batch_size=16,
        target_update_interval=3,
        max_gradient_norm=0.25,
        gradients="by_hand",
        seed=5,
        network="plain",
        loss="huber",
        soft_target_rate=None,
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
