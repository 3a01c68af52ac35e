"""The neighbour search against numpy's stable argsort."""

import numpy as np
import pytest

from tests.sim_core.kernels import orca_step

REAL = np.float32


def neighbours_of(robot, pos, range_m, max_neighbours, hidden=-1):
    """The kernels' neighbours of `robot`, nearest first."""
    pos = np.asarray(pos, REAL)
    zero = np.zeros_like(pos)
    settings = {"range_m": range_m, "max_neighbours": max_neighbours, "hidden": hidden}
    return list(orca_step(pos, zero, zero, **settings).neighbours[robot])


def brute_force(robot, pos, range_m, max_neighbours, hidden=-1):
    """The same list by sorting all robots; equal distances stay in index order."""
    delta = pos[robot] - pos
    dist_sq = delta[:, 0] * delta[:, 0] + delta[:, 1] * delta[:, 1]
    order = np.argsort(dist_sq, kind="stable")
    keep = (dist_sq[order] < REAL(range_m) ** 2) & (order != robot) & (order != hidden)
    return list(order[keep][:max_neighbours])


@pytest.mark.parametrize("step_m", [None, 0.25])
def test_random_scenes_match_a_sort(step_m):
    rng = np.random.default_rng(1)
    ties = 0
    for _ in range(400):
        n, max_neighbours = int(rng.integers(1, 60)), int(rng.integers(1, 16))
        pos = rng.uniform(-2, 2, (n, 2)).astype(REAL)
        if step_m is not None:  # a coarse lattice: exact ties everywhere, and coincident robots
            pos = (np.round(pos / step_m) * step_m).astype(REAL)
        robot, hidden = int(rng.integers(n)), int(rng.integers(-1, n))
        found = neighbours_of(robot, pos, 1.5, max_neighbours, hidden)
        assert found == brute_force(robot, pos, 1.5, max_neighbours, hidden)
        distances = np.sum((pos[found] - pos[robot]) ** 2, axis=1)
        ties += len(distances) - len(np.unique(distances))
    assert (ties > 400) == (step_m is not None)


def test_a_full_list_keeps_the_lower_index_of_a_tie():
    pos = [[0, 0], [0, 1], [1, 0], [-1, 0], [0, -1]]
    assert neighbours_of(0, pos, 1.5, 2) == [1, 2]
    assert neighbours_of(4, pos, 3.0, 3) == [0, 2, 3]


def test_a_hidden_robot_is_nobodys_neighbour_but_has_neighbours():
    pos = [[0, 0], [0.1, 0], [0.2, 0]]
    for robot in (0, 2):
        assert 1 not in neighbours_of(robot, pos, 1.5, 10, hidden=1)
        assert 1 in neighbours_of(robot, pos, 1.5, 10)
    assert neighbours_of(1, pos, 1.5, 10, hidden=1) == [0, 2]


def test_a_hidden_robot_takes_no_entry_of_a_list():
    pos = [[0, 0], [0.1, 0], [0.2, 0], [0.3, 0]]
    assert neighbours_of(0, pos, 1.5, 2, hidden=1) == [2, 3]


def test_the_range_is_exclusive():
    inside = float(np.nextafter(REAL(1.5), REAL(0)))
    assert neighbours_of(0, [[0, 0], [1.5, 0]], 1.5, 4) == []
    assert neighbours_of(0, [[0, 0], [inside, 0]], 1.5, 4) == [1]


def test_coincident_robots_are_neighbours_and_a_robot_is_not_its_own():
    assert neighbours_of(1, [[3, 3], [3, 3], [3, 3]], 1.5, 4) == [0, 2]
    assert neighbours_of(0, [[0, 0]], 1.5, 4) == []
