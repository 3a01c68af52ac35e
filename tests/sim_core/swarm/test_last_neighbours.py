"""The neighbour search reuses the lists of the last step. Whatever they hold, it returns the nearest robots."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_core.config import WorldConfig
from sim_core.pilot import Pilot
from sim_core.worlds import WorldBatch
from tests.sim_core.kernels import orca_step
from tests.sim_core.swarm.test_neighbours import brute_force

REAL = np.float32


def random_lists(n, max_neighbours, rng):
    """For each of `n` robots, up to `max_neighbours` others in any order, -1 for none."""
    lists = np.full((n, max_neighbours), -1)
    for robot in range(n):
        others = rng.permutation(np.delete(np.arange(n), robot))[: rng.integers(max_neighbours + 1)]
        lists[robot, : len(others)] = others
    return lists


def all_neighbours(pos, last_lists, range_m, max_neighbours, hidden=-1):
    """Neighbours of every robot, found from the lists of the last step."""
    zero = np.zeros_like(pos)
    settings = {"range_m": range_m, "max_neighbours": max_neighbours, "hidden": hidden, "last_lists": last_lists}
    return [found.tolist() for found in orca_step(pos, zero, zero, **settings).neighbours]


def all_brute_force(pos, range_m, max_neighbours, hidden=-1):
    return [brute_force(robot, pos, range_m, max_neighbours, hidden) for robot in range(len(pos))]


@settings(max_examples=400, deadline=None, derandomize=True)
@given(
    n=st.integers(1, 60),
    max_neighbours=st.integers(1, 14),
    range_m=st.sampled_from([0.25, 0.75, 1.5, 9.0]),
    step_m=st.sampled_from([None, 0.25, 0.75]),
    hidden=st.integers(-1, 59),
    seed=st.integers(0, 10**6),
)
def test_any_last_lists_lead_to_the_nearest_robots(n, max_neighbours, range_m, step_m, hidden, seed):
    rng = np.random.default_rng(seed)
    pos = rng.uniform(-2, 2, (n, 2)).astype(REAL)
    if step_m is not None:  # exact ties, coincident robots, robots at exactly the range's distance
        pos = (np.round(pos / step_m) * step_m).astype(REAL)
    hidden = min(hidden, n - 1)
    lists = random_lists(n, max_neighbours, rng)
    expected = all_brute_force(pos, range_m, max_neighbours, hidden)
    assert all_neighbours(pos, lists, range_m, max_neighbours, hidden) == expected


@pytest.mark.parametrize("max_neighbours", [1, 3, 10])
def test_last_lists_that_are_right_or_lack_one_robot_lead_to_the_nearest(max_neighbours):
    rng = np.random.default_rng(3)
    for n in (2, 9, 40):
        pos = rng.uniform(-1.5, 1.5, (n, 2)).astype(REAL)
        expected = all_brute_force(pos, 1.5, max_neighbours)
        right = np.array([found + [-1] * (max_neighbours - len(found)) for found in expected])
        for missing in range(max_neighbours):
            lists = np.full_like(right, -1)
            lists[:, : max_neighbours - 1] = np.delete(right, missing, axis=1)
            assert all_neighbours(pos, right, 1.5, max_neighbours) == expected
            assert all_neighbours(pos, lists, 1.5, max_neighbours) == expected


@pytest.mark.parametrize("robots, groups", [(5, 2), (7, 1), (8, 5)])
def test_worlds_that_load_a_state_continue_like_fresh_worlds(robots, groups):
    config = WorldConfig(robots=robots, groups=groups, arena_radius_m=2.5)
    fresh, used = WorldBatch(config, 9), WorldBatch(config, 9)
    used.seed(list(range(100, 109)))
    used.reset()
    for _ in range(40):
        used.step(Pilot.FREE)
    fresh.reset()
    used.set_state(fresh.get_state())
    for step in range(60):
        if step == 30:
            mask = np.arange(9) % 2 == 0
            fresh.reset(mask), used.reset(mask)
        fresh.step(Pilot.FREE), used.step(Pilot.FREE)
        for name, array in fresh.get_state().items():
            np.testing.assert_array_equal(used.get_state()[name], array, err_msg=name)
