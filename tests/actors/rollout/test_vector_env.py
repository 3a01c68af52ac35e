"""Vector environments: same-step restarts, next observations, and refusals."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from actors.rollout.env_spec import EnvSpec
from actors.rollout.vector_env import env_shape, final_observations, make_vector_env, reset_seeded, spaces_of
from sim_core.checks import ConfigError
from sim_core.config import WorldConfig
from sim_core.envs import SwarmEnv, SwarmVectorEnv

NUM_ENVS = 3


class OddSpaces(gym.Env):
    """An environment with spaces that a test chooses."""

    def __init__(self, observation, action):
        self.observation_space, self.action_space = observation, action

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}


@pytest.fixture
def odd_id():
    """Function: registers spaces under an id that is removed after the test."""
    env_id = "shoal-test/Odd-v0"

    def register(observation, action):
        gym.register(env_id, lambda: OddSpaces(observation, action), disable_env_checker=True)
        return EnvSpec(env_id, WorldConfig())

    yield register
    gym.registry.pop(env_id, None)


def single_envs(spec):
    if spec.is_swarm:
        return [SwarmEnv(**spec.settings) for _ in range(NUM_ENVS)]
    return [gym.make(spec.env_id) for _ in range(NUM_ENVS)]


@pytest.mark.parametrize("name", ["swarm", "cart_pole"])
def test_next_observations_equal_those_of_single_environments(name, request):
    spec = request.getfixturevalue(name)
    env, singles, seeds = make_vector_env(spec, NUM_ENVS), single_envs(spec), [11, 5, 7]
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    observation = reset_seeded(env, seeds)
    expected = [single.reset(seed=seed)[0] for single, seed in zip(singles, seeds, strict=True)]
    np.testing.assert_array_equal(observation, expected)
    rng, ended = np.random.default_rng(0), 0
    for _ in range(120):
        action = rng.integers(spaces_of(env).num_actions, size=NUM_ENVS)
        observation, reward, terminated, truncated, infos = env.step(action)
        kept, done = observation.copy(), terminated | truncated
        reached = final_observations(observation, done, infos)
        for i, single in enumerate(singles):
            last, reward_i, terminated_i, truncated_i, _ = single.step(action[i])
            assert (reward[i], terminated[i], truncated[i]) == (reward_i, terminated_i, truncated_i)
            np.testing.assert_array_equal(reached[i], last)
            first = single.reset()[0] if done[i] else last
            np.testing.assert_array_equal(observation[i], first)
        np.testing.assert_array_equal(observation, kept)
        ended += done.sum()
    assert ended >= 5
    env.close()


def test_without_an_ended_episode_next_observations_are_the_observations(swarm):
    observation = np.zeros((2, 3))
    assert final_observations(observation, np.zeros(2, np.bool_), {}) is observation


def test_environments_and_their_shapes(swarm, cart_pole):
    assert isinstance(make_vector_env(swarm, 2).unwrapped, SwarmVectorEnv)
    assert env_shape(swarm).observation_size == 2 * swarm.world.sectors
    assert env_shape(swarm).num_actions == swarm.world.num_actions
    assert env_shape(cart_pole).observation_size == 4 and env_shape(cart_pole).num_actions == 2
    stop = swarm._replace(world=WorldConfig(sectors=5, stop_action=True))
    assert (env_shape(stop).observation_size, env_shape(stop).num_actions) == (10, 6)


@pytest.mark.parametrize("env_id", ["NoSuchEnv-v0", "shoal/NoSuchEnv-v0", "nowhere/Env-v1", "CartPole-v99", "a b c"])
def test_unknown_ids_are_refused(env_id):
    with pytest.raises(ConfigError, match="env_id"):
        make_vector_env(EnvSpec(env_id, WorldConfig()), 1)


def test_continuous_actions_are_refused():
    with pytest.raises(ConfigError, match="Pendulum-v1.*Discrete actions"):
        env_shape(EnvSpec("Pendulum-v1", WorldConfig()))


BOX, DISCRETE = gym.spaces.Box(-1, 1, (2,)), gym.spaces.Discrete(2)


@pytest.mark.parametrize(
    ("observation", "action", "words"),
    [
        (gym.spaces.Sequence(BOX), DISCRETE, "cannot be flattened to a Box"),
        (BOX, gym.spaces.MultiDiscrete([2, 2]), "Discrete actions"),
        (BOX, gym.spaces.Discrete(3, start=1), "Discrete actions from 0"),
    ],
)
def test_other_spaces_are_refused(odd_id, observation, action, words):
    with pytest.raises(ConfigError, match=words):
        make_vector_env(odd_id(observation, action), 2)
