"""Our environment under somebody else's learner: stable-baselines3."""

import gymnasium as gym
import numpy as np
from stable_baselines3 import DQN
from stable_baselines3.common.env_checker import check_env

from sim_core import ENV_ID
from sim_core.envs import SwarmEnv

SETTINGS = {"robots": 4, "groups": 2, "arena_radius_m": 2.0, "horizon_steps": 60}


def test_its_checker_finds_nothing_to_complain_about():
    check_env(SwarmEnv(render_mode="rgb_array", **SETTINGS), warn=True)


def test_its_dqn_trains():
    env = gym.make(ENV_ID, **SETTINGS)
    model = DQN("MlpPolicy", env, learning_starts=100, buffer_size=500, seed=0, device="cpu")
    before = [parameter.detach().clone() for parameter in model.q_net.parameters()]
    model.learn(500)
    assert model.num_timesteps == 500
    moved = [not np.array_equal(a, b.detach()) for a, b in zip(before, model.q_net.parameters(), strict=True)]
    assert all(moved)
    action, _ = model.predict(env.reset(seed=1)[0], deterministic=True)
    assert env.action_space.contains(np.int64(action))
