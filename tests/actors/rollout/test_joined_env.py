"""Several setups as one vector environment: each part is the environment that it would be alone."""

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from actors.rollout.env_spec import EnvSpec
from actors.rollout.joined_env import JoinedVectorEnv
from actors.rollout.vector_env import final_observations, make_vector_env, reset_seeded, spaces_of
from sim_core import ENV_ID
from sim_core.config import WorldConfig
from sim_core.envs import SwarmVectorEnv

SMALL = {"arena_radius_m": 2.0, "horizon_steps": 23, "decision_interval_steps": 2}
SETUPS = ((3, 2, 4), (5, 1, 1), (2, 4, 3))
"""Robots per group, groups, worlds."""


def part(robots, groups, count):
    return SwarmVectorEnv(count, robots=robots, groups=groups, **SMALL)


@pytest.fixture
def joined():
    return JoinedVectorEnv([part(*setup) for setup in SETUPS])


def assert_same_infos(infos, alone, rows):
    """What the joined environment tells of `rows` is what the part alone tells."""
    assert infos["_final_obs"][rows].any() == bool(alone)
    if not alone:
        return
    done = alone["_final_obs"]
    np.testing.assert_array_equal(infos["_final_obs"][rows], done)
    np.testing.assert_array_equal(infos["final_obs"][rows][done], alone["final_obs"][done])
    assert infos["final_info"].keys() == alone["final_info"].keys()
    for name, column in alone["final_info"].items():
        np.testing.assert_array_equal(infos["final_info"][name][rows][done], column[done])


def test_each_part_plays_as_it_does_alone(joined):
    parts = [part(*setup) for setup in SETUPS]
    seeds, ends = list(range(70, 78)), np.cumsum([count for *_, count in SETUPS])
    slices = [slice(end - count, end) for end, (*_, count) in zip(ends, SETUPS, strict=True)]
    first = reset_seeded(joined, seeds)
    np.testing.assert_array_equal(
        first, np.concatenate([reset_seeded(own, seeds[rows]) for own, rows in zip(parts, slices, strict=True)])
    )
    rng, ended = np.random.default_rng(0), np.zeros(8, int)
    for _ in range(60):
        actions = rng.integers(8, size=8)
        observation, reward, terminated, truncated, infos = joined.step(actions)
        assert bool(infos) == bool((terminated | truncated).any())
        for own, rows in zip(parts, slices, strict=True):
            alone = own.step(actions[rows])
            together = observation, reward, terminated, truncated
            for column, expected in zip(together, alone[:4], strict=True):
                np.testing.assert_array_equal(column[rows], expected)
            if infos:
                assert_same_infos(infos, alone[4], rows)
        ended += terminated | truncated
        final = final_observations(observation, terminated | truncated, infos)
        assert final.shape == observation.shape
    assert (ended >= 3).all()


def test_saved_worlds_go_on_bit_for_bit(joined):
    reset_seeded(joined, list(range(8)))
    rng = np.random.default_rng(1)
    for _ in range(20):
        before = joined.step(rng.integers(8, size=8))[0]
    other = JoinedVectorEnv([part(*setup) for setup in SETUPS])
    reset_seeded(other, list(range(50, 58)))
    np.testing.assert_array_equal(other.set_state(joined.get_state()), before)
    for _ in range(30):
        actions = rng.integers(8, size=8)
        for column, expected in zip(other.step(actions)[:4], joined.step(actions)[:4], strict=True):
            np.testing.assert_array_equal(column, expected)


@pytest.mark.parametrize(
    ("shares", "count", "expected"),
    [
        ((1, 1, 1), 3, [1, 1, 1]),
        ((1, 1, 1), 8, [3, 3, 2]),
        ((1, 2, 5), 11, [2, 3, 6]),
        ((1, 1000, 1), 10, [1, 8, 1]),
    ],
)
def test_every_setup_has_its_share_of_the_environments(shares, count, expected):
    worlds = [WorldConfig(robots=robots, groups=groups) for robots, groups, _ in SETUPS]
    spec = EnvSpec(ENV_ID, worlds[0], tuple(zip(worlds, shares, strict=True)))
    env = make_vector_env(spec, count)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP and env.num_envs == count
    assert [own.num_envs for own in env._parts] == expected
    assert [own.config for own in env._parts] == worlds
    assert spaces_of(env).num_actions == 8
