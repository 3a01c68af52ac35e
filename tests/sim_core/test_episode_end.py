"""How episodes end: hand-made scenes, edges and precedence."""

import numpy as np
import pytest
from scipy.optimize import linprog

from sim_core.episode_end import (
    collides,
    collision_or_goal,
    end_of_step,
    group_goal_distance_m,
    lost_or_captured,
    sensed,
    surrounded,
)
from sim_core.outcomes import Outcome

REAL = np.float32
RANGE_M, CONTACT_M = 1.5, 0.2
FAR = 50.0
ROBOT, MATE, OTHER_A, OTHER_B = range(4)


def outcome(pos, goal=(FAR, FAR), robot=ROBOT, must_surround=False, of_centroid=False):
    """Outcome of two groups of two (robots 0, 1 and 2, 3)."""
    pos_x, pos_y = np.ascontiguousarray(np.asarray(pos, REAL).T)
    begin = robot // 2 * 2
    x, y = (REAL(goal[0]), REAL(goal[1])) if begin == 0 else (REAL(-FAR), REAL(-FAR))
    limits = REAL(CONTACT_M) ** 2, REAL(RANGE_M)
    ended = end_of_step(robot, begin, begin + 2, pos_x, pos_y, x, y, *limits, of_centroid, must_surround)
    return Outcome(ended)


ALONE = [(0, 0), (9, 0), (0, 9), (0, -9)]
TOGETHER = [(0, 0), (1.0, 0), (0, 9), (0, -9)]
AMONG = [(0, 0), (9, 0), (1.0, 0), (0, -9)]
MIXED = [(0, 0), (1.0, 0), (-1.0, 0), (0, 1.2)]


def test_each_outcome():
    assert outcome(TOGETHER) is Outcome.RUNNING
    assert outcome(MIXED) is Outcome.RUNNING
    assert outcome(ALONE) is Outcome.LOST
    assert outcome(AMONG) is Outcome.CAPTURED
    assert outcome([(0, 0), (0.19, 0), (0, 9), (0, -9)]) is Outcome.COLLISION
    assert outcome([(0, 0), (1.0, 0), (0, 0.19), (0, -9)]) is Outcome.COLLISION
    assert outcome(TOGETHER, goal=(0.5, 0)) is Outcome.GOAL


def test_collision_comes_before_goal():
    touching = [(0, 0), (0.1, 0), (0, 9), (0, -9)]
    assert outcome(touching, goal=(0.05, 0)) is Outcome.COLLISION


def test_goal_comes_before_lost_and_captured():
    apart = [(-1.0, 0), (1.0, 0), (0, 9), (0, -9)]  # 2 m from each other, 1 m from the goal
    assert outcome(apart) is Outcome.LOST
    assert outcome(apart, goal=(0, 0)) is Outcome.GOAL
    apart[OTHER_A] = (-1.0, 0.5)
    assert outcome(apart) is Outcome.CAPTURED
    assert outcome(apart, goal=(0, 0)) is Outcome.GOAL


def test_collision_comes_before_captured():
    assert outcome([(0, 0), (9, 0), (0.1, 0), (0, -9)]) is Outcome.COLLISION


def test_a_crash_between_others_is_no_collision():
    assert outcome([(0, 0), (1.0, 0), (5, 5), (5, 5.05)]) is Outcome.RUNNING
    assert outcome([(0, 0), (1.0, 0), (1.0, 0.05), (5, 5)]) is Outcome.RUNNING


def test_groups_are_those_of_the_robot_asked_about():
    assert outcome([(0, 9), (0, -9), (0, 0), (1.0, 0)], robot=OTHER_A) is Outcome.RUNNING
    assert outcome([(0, 0.5), (0, -9), (0, 0), (9, 0)], robot=OTHER_B) is Outcome.LOST
    assert outcome([(8.9, 1), (0, -9), (0, 0), (9, 0)], robot=OTHER_B) is Outcome.CAPTURED
    assert outcome([(0, 0), (1, 0), (30, 30), (31, 30)], goal=(0.5, 0), robot=OTHER_A) is Outcome.RUNNING


def test_edges_are_open():
    def just_below(value):
        return float(np.nextafter(REAL(value), REAL(-1)))

    assert outcome([(0, 0), (1.5, 0), (0, 9), (0, -9)]) is Outcome.LOST
    assert outcome([(0, 0), (just_below(1.5), 0), (0, 9), (0, -9)]) is Outcome.RUNNING
    assert outcome([(0, 0), (0.2, 0), (0, 9), (0, -9)]) is Outcome.RUNNING
    assert outcome([(0, 0), (just_below(0.2), 0), (0, 9), (0, -9)]) is Outcome.COLLISION
    # mean distance of the group, not the learning robot's own: 0.5 and 2.5 give 1.5
    pair = [(0.5, 0), (2.5, 0), (0, 9), (0, -9)]
    assert outcome(pair, goal=(0, 0)) is Outcome.LOST
    assert outcome([(0.5, 0), (2.49, 0), (0, 9), (0, -9)], goal=(0, 0)) is Outcome.GOAL


def test_goal_distance_of_a_group_matches_numpy():
    rng = np.random.default_rng(0)
    for _ in range(50):
        robots, groups = int(rng.integers(2, 26)), int(rng.integers(1, 9))
        pos = rng.normal(0, 5, (robots * groups, 2)).astype(REAL)
        goal = rng.normal(0, 5, (groups, 2)).astype(REAL)
        for g in range(groups):
            own = pos[g * robots : (g + 1) * robots].astype(np.float64)
            expected = {False: np.linalg.norm(own - goal[g], axis=1).mean()}
            expected[True] = np.linalg.norm(own.mean(axis=0) - goal[g])
            for of_centroid, distance_m in expected.items():
                args = (*np.ascontiguousarray(pos.T), *goal[g], of_centroid)
                found = group_goal_distance_m(g * robots, (g + 1) * robots, *args)
                assert found == pytest.approx(distance_m, rel=1e-6, abs=1e-6)


def test_a_group_around_its_goal_is_there_by_its_centroid_alone():
    spread = [(-2.0, 0), (2.0, 0), (0, 9), (0, -9)]
    assert outcome(spread, goal=(0, 0)) is Outcome.LOST
    assert outcome(spread, goal=(0, 0), of_centroid=True) is Outcome.GOAL
    assert outcome(spread, goal=(1.5, 0), of_centroid=True) is Outcome.LOST  # the edge is open


def test_sensing_and_contact_match_numpy():
    rng = np.random.default_rng(1)
    for _ in range(100):
        pos = rng.uniform(-1.5, 1.5, (30, 2)).astype(REAL)
        robot = int(rng.integers(30))
        delta = pos - pos[robot]
        dist_sq = delta[:, 0] * delta[:, 0] + delta[:, 1] * delta[:, 1]
        near = (dist_sq < REAL(1)) & (np.arange(30) != robot)
        own = np.arange(30) // 10 == robot // 10
        pos_x, pos_y = np.ascontiguousarray(pos.T)
        assert sensed(robot, robot // 10 * 10, robot // 10 * 10 + 10, pos_x, pos_y, REAL(1)) == (
            (near & own).sum(),
            (near & ~own).sum(),
        )
        nearest_sq = np.delete(dist_sq, robot).min()
        assert not collides(robot, pos_x, pos_y, nearest_sq)
        assert collides(robot, pos_x, pos_y, np.nextafter(nearest_sq, REAL(9)))


def test_lost_or_captured():
    for pos, expected in ((ALONE, "LOST"), (TOGETHER, "LOST"), (MIXED, "LOST"), (AMONG, "CAPTURED")):
        pos_x, pos_y = np.ascontiguousarray(np.asarray(pos, REAL).T)
        assert lost_or_captured(ROBOT, 0, 2, pos_x, pos_y, REAL(RANGE_M) ** 2, False) == Outcome[expected]


THREE_AROUND = [(1.0, -0.5), (-1.0, -0.5), (0, 1.0)]
"""Robots whose hull holds the origin."""


def learner_and(others):
    """Positions of a group of three at the origin, its mates far away, and of a group of three others."""
    return np.ascontiguousarray(np.array([(0, 0), (FAR, 0), (0, FAR), *others], REAL).T)


@pytest.mark.parametrize(
    ("others", "expected"),
    [
        (THREE_AROUND, "CAPTURED"),
        ([(x, y + 0.75) for x, y in THREE_AROUND], "LOST"),  # all above it
        ([(2 * x, 2 * y) for x, y in THREE_AROUND], "LOST"),  # too far to be sensed
        ([*THREE_AROUND[:2], (0, 9.0)], "LOST"),  # the third is
        ([(1.0, 0), (-1.0, 0), (9.0, 9.0)], "LOST"),  # between two, on the edge of their hull
        ([(FAR, 9), (FAR, 8), (FAR, 7)], "LOST"),
    ],
)
def test_captured_may_have_to_be_surrounded(others, expected):
    pos_x, pos_y = learner_and(others)
    assert lost_or_captured(0, 0, 3, pos_x, pos_y, REAL(RANGE_M) ** 2, True) == Outcome[expected]
    limits = REAL(CONTACT_M) ** 2, REAL(RANGE_M)
    ended = end_of_step(0, 0, 3, pos_x, pos_y, REAL(FAR), REAL(FAR), *limits, False, True)
    assert ended == Outcome[expected]


def test_who_senses_an_own_robot_is_not_captured_among_others_all_around():
    pos_x, pos_y = learner_and(THREE_AROUND)
    pos_x[1] = 1.2
    assert lost_or_captured(0, 0, 3, pos_x, pos_y, REAL(RANGE_M) ** 2, True) == Outcome.LOST


def inside_hull(point, corners):
    """Whether the point is a convex combination of the corners."""
    if not len(corners):
        return False
    system = np.vstack([np.asarray(corners, np.float64).T, np.ones(len(corners))])
    return linprog(np.zeros(len(corners)), A_eq=system, b_eq=[*point, 1.0]).success


def test_surrounded_is_inside_the_convex_hull():
    rng = np.random.default_rng(2)
    found = []
    for _ in range(300):
        pos = rng.uniform(-0.9, 0.9, (int(rng.integers(1, 20)), 2)).astype(REAL)
        near = [p for p in pos[1:] if np.sum((p - pos[0]) ** 2) < REAL(1)]
        found.append(surrounded(0, *np.ascontiguousarray(pos.T), REAL(1)))
        assert found[-1] == inside_hull(pos[0], near)
    assert 50 < sum(found) < 250


def test_collision_or_goal_knows_nothing_of_lost():
    for mate, expected in ((2.9, "GOAL"), (3.1, "RUNNING"), (0.1, "COLLISION")):
        pos_x, pos_y = np.array([0, mate, 9, -9], REAL), np.array([0, 0, 9, -9], REAL)
        limits = REAL(CONTACT_M) ** 2, REAL(RANGE_M)
        found = collision_or_goal(ROBOT, 0, 2, pos_x, pos_y, REAL(0), REAL(0), *limits, False)
        assert found == Outcome[expected]
