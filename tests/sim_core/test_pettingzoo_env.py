"""The world as a PettingZoo environment: PettingZoo's own tests, and the worlds behind it."""

import sys
import warnings
from types import SimpleNamespace

import numpy as np
import pytest

import sim_core
from sim_core.checks import ConfigError
from sim_core.outcomes import Outcome
from sim_core.worlds import WorldBatch

with warnings.catch_warnings(action="ignore"):  # of its own examples
    from pettingzoo.test import max_cycles_test, parallel_api_test, parallel_seed_test
    from pettingzoo.utils import parallel_to_aec

SMALL = {"robots": 4, "groups": 2, "arena_radius_m": 2.0, "horizon_steps": 60}
VARIANTS = [
    {},
    {"learners": 0.5, "method": "in", "ended_learners": "leave"},
    {"learners": "one", "method": "out", "outside_limit_steps": 5},
    {"position_noise_m": 0.02, "history": 2, "decision_interval_steps": 2},
]


@pytest.mark.parametrize("settings", VARIANTS)
def test_pettingzoos_own_test_of_the_interface(settings):
    parallel_api_test(sim_core.parallel_env(**(SMALL | settings)), num_cycles=300)


@pytest.mark.parametrize("settings", VARIANTS)
def test_pettingzoos_own_test_of_seeds(settings):
    parallel_seed_test(lambda: sim_core.parallel_env(**(SMALL | settings)), num_cycles=100)


def test_pettingzoos_own_test_of_the_horizon():
    def parallel_env(max_cycles):
        return sim_core.parallel_env(**(SMALL | {"horizon_steps": max_cycles}))

    def env(max_cycles):
        return parallel_to_aec(parallel_env(max_cycles))

    max_cycles_test(SimpleNamespace(parallel_env=parallel_env, env=env))


@pytest.mark.parametrize("settings", VARIANTS)
def test_agents_are_the_rows_of_a_world(settings):
    env = sim_core.parallel_env(**(SMALL | settings))
    worlds = WorldBatch(env.config, 1)
    rng = np.random.default_rng(0)
    for seed in (3, 4, 5):
        worlds.seed([seed])
        expected, (observations, infos) = worlds.reset(), env.reset(seed=seed)
        assert env.agents == env.possible_agents == list(observations) == list(infos)
        np.testing.assert_array_equal(np.stack(list(observations.values())), expected)
        while env.agents:
            present, actions = list(env.agents), rng.integers(0, 8, len(env.possible_agents))
            rows = [int(agent.removeprefix("robot_")) for agent in present]
            observations, rewards, terminations, truncations, infos = env.step(
                {agent: int(actions[row]) for agent, row in zip(present, rows, strict=True)}
            )
            result = worlds.step(actions)
            np.testing.assert_array_equal(np.flatnonzero(result.decided), rows)
            for agent, row in zip(present, rows, strict=True):
                np.testing.assert_array_equal(observations[agent], result.observation[row])
                assert rewards[agent] == result.reward[row] and infos[agent]["outcome"] == result.outcome[row]
                assert infos[agent]["robot"] == worlds.state.learner[row]
                ended = result.outcome[row] != Outcome.RUNNING
                assert (terminations[agent] or truncations[agent]) == ended == (agent not in env.agents)
                if ended:
                    assert infos[agent]["episode_length"] == result.steps[row]
                    assert infos[agent]["episode_return"] == result.episode_return[row]
        assert worlds.ended_worlds().all() and env.step({}) == ({}, {}, {}, {}, {})


def test_the_state_holds_the_whole_world_and_images_show_it():
    env = sim_core.parallel_env(render_mode="rgb_array", **SMALL)
    env.reset(seed=1)
    state = env.state()
    assert state.shape == (4 * 8 + 2 * 2,) and state.dtype == np.float32
    np.testing.assert_array_equal(np.stack([state[:8], state[8:16]], axis=-1), env.worlds.positions()[0])
    np.testing.assert_array_equal(np.stack([state[32:34], state[34:]], axis=-1), env.worlds.goals()[0])
    assert env.render().shape == (480, 480, 3)
    assert sim_core.parallel_env(**SMALL).render() is None


def test_what_cannot_be_is_refused(monkeypatch):
    env = sim_core.parallel_env(**SMALL)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="actions must be those of"):
        env.step({"robot_0": 1})
    with pytest.raises(ValueError, match=r"action of robot_3 must be in 0\.\.7, not 8"):
        env.step(dict.fromkeys(env.agents, 0) | {"robot_3": 8})
    with pytest.raises(ConfigError, match="unknown setting 'max_cycles'"):
        sim_core.parallel_env(max_cycles=3)
    with pytest.raises(ValueError, match="seed"):
        env.reset(seed=-1)
    monkeypatch.setattr(sys, "path", [])
    monkeypatch.delitem(sys.modules, "pettingzoo")
    sys.path_importer_cache.clear()
    with pytest.raises(ConfigError, match=r"sim_core.parallel_env needs the package pettingzoo: install it with `pip"):
        sim_core.parallel_env(**SMALL)
