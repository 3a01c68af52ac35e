"""The vector environment whose rows are learning robots."""

import gymnasium as gym
import numpy as np
import pytest

from sim_core import ENV_ID
from sim_core.checks import ConfigError
from sim_core.envs import SwarmEnv, SwarmVectorEnv
from sim_core.outcomes import Outcome
from sim_core.worlds import WorldBatch

SMALL = {"robots": 4, "groups": 2, "arena_radius_m": 2.0, "horizon_steps": 40}


def test_rows_are_the_robots_of_a_batch_of_worlds():
    """Observations, rewards and flags are those of the worlds; a world restarts in the step of its last robot's end."""
    envs = gym.make_vec(ENV_ID, num_envs=24, learners=1.0, **SMALL)
    worlds = WorldBatch(envs.unwrapped.config, 3)
    worlds.seed([5, 6, 7])
    np.testing.assert_array_equal(envs.reset(seed=5)[0], worlds.reset())
    waited = restarts = 0
    for action in np.random.default_rng(0).integers(0, 8, (150, 24)):
        observation, reward, terminated, truncated, infos = envs.step(action)
        result, over = worlds.step(action), worlds.ended_worlds()
        done = terminated | truncated
        np.testing.assert_array_equal(infos["decided"], result.decided)
        np.testing.assert_array_equal(done, result.decided & (result.outcome != Outcome.RUNNING))
        np.testing.assert_array_equal(truncated, result.decided & (result.outcome == Outcome.TIMEOUT))
        np.testing.assert_array_equal(reward, result.reward)
        assert (reward[~infos["decided"]] == 0).all() and not done[~infos["decided"]].any()
        waited += (~infos["decided"]).sum()
        if done.any():
            np.testing.assert_array_equal(infos["_final_info"], done)
            np.testing.assert_array_equal(infos["final_obs"], result.observation)
            for name, array in (
                ("outcome", result.outcome),
                ("episode_length", result.steps),
                ("episode_return", result.episode_return),
            ):
                np.testing.assert_array_equal(infos["final_info"][name], array)
        expected = worlds.reset(over) if over.any() else result.observation
        np.testing.assert_array_equal(observation, expected)
        restarts += over.sum()
    assert waited > 100 and restarts > 3
    envs.close()


def test_what_cannot_be_is_refused_in_one_sentence():
    with pytest.raises(ConfigError, match="num_envs must be a multiple of 8, the learning robots of a world"):
        SwarmVectorEnv(20, learners=1.0, **SMALL)
    with pytest.raises(ConfigError, match="autoreset_mode must be SAME_STEP where several robots of a world learn"):
        SwarmVectorEnv(8, learners=1.0, autoreset_mode=gym.vector.AutoresetMode.NEXT_STEP, **SMALL)
    with pytest.raises(ConfigError, match=r"learners must be one in an environment of one agent, not 1\.0: several"):
        SwarmEnv(learners=1.0, **SMALL)


def test_all_learning_robots_are_drawn():
    envs = SwarmVectorEnv(16, render_mode="rgb_array", learners=1.0, ended_learners="leave", **SMALL)
    envs.reset(seed=1)
    before = envs.render()
    assert len(before) == 2 and before[0].shape == (480, 480, 3)
    envs.worlds.state.pos_x[0, 0] = envs.worlds.state.pos_y[0, 0] = np.nan  # it has left
    after = envs.render()
    black = [(image == 0).all(axis=-1).sum() for image in (before[0], after[0])]
    assert 0 < black[1] < black[0]
    np.testing.assert_array_equal(before[1], after[1])
