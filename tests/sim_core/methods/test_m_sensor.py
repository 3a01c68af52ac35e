"""M_sensor: perception by brute force, Eq. 3.3 and 3.4, Table 3.1 and the outcomes with their clock."""

import dataclasses
import itertools

import numpy as np
import pytest

from sim_core.checks import ConfigError
from sim_core.config import WorldConfig
from sim_core.methods import make_method
from sim_core.methods.headings import heading_velocities
from sim_core.methods.m_sensor import COUNT_LIMIT, sector_edges, sector_of
from sim_core.outcomes import Outcome
from sim_core.plugins import METHODS
from sim_core.state import empty_state

REAL = np.float32
ALL = np.ones(1, np.bool_)


def observe(config, state):
    """The method's observation of one world."""
    method = make_method(config)
    out = np.full((1, *method.observation_shape), 99, method.observation_dtype)
    method.perceive(state, ALL, out)
    return out[0]


def brute_force(config, pos, learner):
    """(counts, clear): the 2q counts by angles in float64, and whether no robot is on an edge."""
    delta = np.delete(pos, learner, axis=0).astype(np.float64) - pos[learner]
    own = np.delete(np.arange(len(pos)), learner) // config.robots == learner // config.robots
    dist, turn = np.hypot(*delta.T), (np.degrees(np.arctan2(delta[:, 1], delta[:, 0])) + 180) % 360
    width, counts, margins = 360 / config.sectors, [], []
    for low, high in ((0.0, config.inner_radius_m), (config.inner_radius_m, config.outer_radius_m)):
        for sector in range(config.sectors):
            inside = (low <= dist) & (dist < high) & (width * sector <= turn) & (turn < width * (sector + 1))
            counts.append(int((inside & own).sum()) - int((inside & ~own).sum()))
            margins += [np.abs(dist - high).min(), np.abs(turn - width * sector).min()]
    return counts, min(margins) > 1e-4


@pytest.mark.parametrize("sectors", [2, 3, 4, 7, 8, 16, 64])
def test_perception_matches_brute_force(sectors, make_state):
    config = WorldConfig(robots=10, groups=3, sectors=sectors)
    rng = np.random.default_rng(sectors)
    compared = 0
    for _ in range(60):
        pos, learner = rng.uniform(-1.6, 1.6, (30, 2)).astype(REAL), int(rng.integers(30))
        counts, clear = brute_force(config, pos, learner)
        if clear:
            compared += 1
            assert observe(config, make_state(config, pos, np.zeros((3, 2)), learner=learner)).tolist() == counts
    assert compared > 30


@pytest.mark.parametrize("sectors", [2, 3, 8])
def test_counts_apart_are_what_the_difference_is_of(sectors, make_state):
    config = WorldConfig(robots=10, groups=3, sectors=sectors)
    apart = dataclasses.replace(config, sensor_counts="separate")
    rng = np.random.default_rng(sectors)
    for _ in range(20):
        pos, learner = rng.uniform(-1.6, 1.6, (30, 2)).astype(REAL), int(rng.integers(30))
        state = make_state(config, pos, np.zeros((3, 2)), learner=learner)
        own, others = observe(apart, state).reshape(2, 2 * sectors)
        assert (own - others).tolist() == observe(config, state).tolist()
        dist_sq = ((np.delete(pos, learner, axis=0) - pos[learner]) ** 2).sum(axis=1)
        mates = np.delete(np.arange(30), learner) // 10 == learner // 10
        assert (own.sum(), others.sum()) == tuple((dist_sq[part] < 1.5**2).sum() for part in (mates, ~mates))


def turned(angle):
    """The rotation by `angle` [2, 2]."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


@pytest.mark.parametrize("sensor_counts", ["difference", "separate"])
def test_sectors_towards_the_goal_are_those_of_a_world_turned_until_the_goal_lies_at_angle_0(sensor_counts, make_state):
    world = WorldConfig(robots=10, groups=3, sectors=6, sensor_counts=sensor_counts)
    facing, rng, compared = dataclasses.replace(world, sector_frame="goal"), np.random.default_rng(6), 0
    for _ in range(60):
        pos, learner = rng.uniform(-1.6, 1.6, (30, 2)).astype(REAL), int(rng.integers(30))
        goals = rng.uniform(-5, 5, (3, 2)).astype(REAL)
        towards = goals[learner // 10] - pos[learner]
        rotation = turned(-np.arctan2(towards[1], towards[0]))
        aligned = (pos - pos[learner]) @ rotation.T
        if brute_force(world, aligned, learner)[1]:
            compared += 1
            seen = observe(facing, make_state(facing, pos, goals, learner=learner))
            assert seen.tolist() == observe(world, make_state(world, aligned, goals, learner=learner)).tolist()
    assert compared > 30


def test_headings_towards_the_goal(make_state):
    config = WorldConfig(robots=2, groups=2, sectors=4, sector_frame="goal", stop_action=True)
    pos, goals = [(0, 0), (1, 0), (5, 5), (4, 5)], [(9, 9), (5, 2)]
    for learner, angle in ((0, np.pi / 4), (2, -np.pi / 2)):
        method, out_x, out_y = make_method(config), np.zeros(1, REAL), np.zeros(1, REAL)
        for action, heading in enumerate(heading_velocities(config, np.float64)):
            method.velocity(make_state(config, pos, goals, learner=learner), np.array([action]), out_x, out_y)
            np.testing.assert_allclose([out_x[0], out_y[0]], turned(angle) @ heading, atol=1e-6)


def test_on_its_goal_a_robot_faces_the_x_axis(make_state):
    config = WorldConfig(robots=2, groups=1, sectors=4, sector_frame="goal")
    state = make_state(config, [(3, 3), (4, 3.5)], [(3, 3)])
    assert observe(config, state).tolist() == observe(WorldConfig(robots=2, groups=1, sectors=4), state).tolist()


@pytest.mark.parametrize("method", ["in", "out"])
def test_only_m_sensor_turns_its_sectors(method):
    with pytest.raises(ConfigError, match="sector_frame must be 'world'"):
        WorldConfig(method=method, sector_frame="goal")


def test_perception_by_hand(make_state):
    config = WorldConfig(robots=3, groups=2, sectors=4)  # sectors start at -180, -90, 0 and 90 degrees
    pos = [(0, 0), (0.3, 0.1), (0.3, 0.2), (-1.0, 0.1), (0.4, 0.1), (0.1, -1.6)]
    counts = observe(config, make_state(config, pos, np.zeros((2, 2)), learner=0))
    assert counts.tolist() == [0, 0, 1, 0, 0, 0, 0, -1]
    counts = observe(config, make_state(config, pos, np.zeros((2, 2)), learner=3))  # the other group's view
    assert counts.tolist() == [0, 0, 0, 0, 0, -1, 1 - 2, 0]


def test_regions_are_half_open(make_state):
    config = WorldConfig(robots=2, groups=1, sectors=2)
    for x, expected in ((0.499, [0, 1, 0, 0]), (0.5, [0, 0, 0, 1]), (1.499, [0, 0, 0, 1]), (1.5, [0, 0, 0, 0])):
        assert observe(config, make_state(config, [(0, 0), (x, 0.0)], [(9, 9)])).tolist() == expected


@pytest.mark.parametrize("sectors", [2, 3, 8, 64])
def test_every_direction_has_a_sector(sectors):
    tiny = REAL(1e-30)
    for x, y in itertools.product((REAL(-1), -tiny, REAL(-0.0), REAL(0.0), tiny, REAL(1)), repeat=2):
        assert 0 <= sector_of(x, y, sector_edges(sectors)) < sectors


@pytest.mark.parametrize("sectors", [2, 3, 4, 5, 7, 8, 12, 16, 64])
def test_sectors_are_those_of_the_angle(sectors):
    rng, edges = np.random.default_rng(sectors), sector_edges(sectors)
    straight = [(x, y) for x, y in itertools.product((-1.0, 0.0, 1.0), repeat=2) if (x, y) != (0, 0)]
    for x, y in [*straight, *rng.normal(size=(500, 2)).astype(REAL)]:
        turn = (np.arctan2(y, x) + np.pi) / (2 * np.pi) * sectors
        exact = round(turn) if abs(turn - round(turn)) < 1e-9 else int(turn)  # an edge belongs to the sector it begins
        assert sector_of(x, y, edges) == min(exact, sectors - 1)


def test_counts_saturate_within_int8(make_state):
    config = WorldConfig(robots=150, groups=1, sectors=2, start_spacing_m=0.4, arena_radius_m=20.0)
    pos = np.concatenate([np.zeros((1, 2)), np.full((149, 2), 0.3)])
    assert observe(config, make_state(config, pos, [(9, 9)])).tolist() == [0, COUNT_LIMIT, 0, 0]
    assert make_method(config).observation_limit == COUNT_LIMIT


def test_only_masked_worlds_are_perceived():
    config = WorldConfig(robots=2, groups=1)
    state, method = empty_state(config, 3, REAL), make_method(config)
    out = np.full((3, 16), 99, np.int8)
    method.perceive(state, np.array([False, True, False]), out)
    assert [set(row) for row in out.tolist()] == [{99}, {0, 1}, {99}]


@pytest.mark.parametrize("sectors", [2, 3, 5, 8, 16, 64])
@pytest.mark.parametrize("stop", [False, True])
def test_headings_point_to_sector_centres_at_constant_speed(sectors, stop):
    config = WorldConfig(sectors=sectors, stop_action=stop, learner_speed_m_s=0.7)
    velocities = heading_velocities(config, REAL)
    assert velocities.shape == (config.num_actions, 2)
    for action in range(sectors):
        assert sector_of(*velocities[action], sector_edges(sectors)) == action
        np.testing.assert_allclose(np.hypot(*velocities[action]), 0.7, rtol=1e-6)
        for turn in (-0.49, 0.49):  # nearly to either edge of the sector: so it is the centre
            angle = np.arctan2(velocities[action, 1], velocities[action, 0]) + turn * 2 * np.pi / sectors
            assert sector_of(REAL(np.cos(angle)), REAL(np.sin(angle)), sector_edges(sectors)) == action
    if stop:
        assert velocities[sectors].tolist() == [0, 0]


@pytest.mark.parametrize("levels", [2, 3])
def test_headings_come_once_more_for_every_lower_speed(levels):
    one = heading_velocities(WorldConfig(learner_speed_m_s=0.6), REAL)
    several = heading_velocities(WorldConfig(learner_speed_m_s=0.6, speed_levels=levels, stop_action=True), REAL)
    assert several.shape == (8 * levels + 1, 2) and several[-1].tolist() == [0, 0]
    for level in range(levels):
        np.testing.assert_allclose(several[8 * level : 8 * (level + 1)], one * (levels - level) / levels, rtol=1e-6)


def test_velocity_looks_up_each_worlds_action():
    config = WorldConfig(sectors=4, stop_action=True)
    method, out_x, out_y = make_method(config), np.zeros(3, REAL), np.zeros(3, REAL)
    method.velocity(None, np.array([2, 0, 4]), out_x, out_y)
    root = np.sqrt(0.5)
    np.testing.assert_allclose(out_x, [root, -root, 0], atol=1e-6)
    np.testing.assert_allclose(out_y, [root, -root, 0], atol=1e-6)


@pytest.mark.parametrize("action", [[0, 8], [-1, 0], [0], [0, 1, 2]])
def test_velocity_refuses_what_is_no_action(action):
    method, out_x, out_y = make_method(WorldConfig(sectors=8)), np.zeros(2, REAL), np.zeros(2, REAL)
    with pytest.raises(ValueError, match="action"):
        method.velocity(None, np.array(action), out_x, out_y)


CASES = [
    # outcome, closer to the goal, expected with clock `step` (t = 8), with clock `horizon` (eta = 500); tau = 3
    (Outcome.RUNNING, True, 3 / 8, 3 / 500),
    (Outcome.RUNNING, False, -3 / 8, -3 / 500),
    (Outcome.TIMEOUT, True, 3 / 8, 3 / 500),
    (Outcome.TIMEOUT, False, -3 / 8, -3 / 500),
    (Outcome.GOAL, True, 3, 3),
    (Outcome.GOAL, False, 3, 3),
    (Outcome.LOST, True, -3, -3),
    (Outcome.CAPTURED, True, -3, -3),
    (Outcome.COLLISION, True, -3, -3),
]


@pytest.mark.parametrize(("outcome", "closer", "by_step", "by_horizon"), CASES)
@pytest.mark.parametrize("clock", ["step", "horizon"])
def test_table_3_1(outcome, closer, by_step, by_horizon, clock, make_state):
    config = WorldConfig(robots=2, groups=2, reward_scale=3.0, reward_clock=clock)
    # robot 3 of group 1 stands 4 m from its own goal; group 0's goal is a decoy it stands on
    state = make_state(config, [(9, 9), (9, 8), (9, 7), (0, 0)], [(0, 0), (4, 0)], learner=3)
    state.goal_distance_m[0] = 4.1 if closer else 3.9
    state.steps[0], state.episode_return[0] = 8, 10.0
    reward = np.zeros(1, REAL)
    make_method(config).reward(state, ALL, np.array([outcome], np.int8), reward)
    expected = by_step if clock == "step" else by_horizon
    assert reward[0] == pytest.approx(expected)
    assert state.episode_return[0] == pytest.approx(10 + expected)
    assert state.goal_distance_m[0] == pytest.approx(4.0)


def test_a_timeout_that_is_a_failure(make_state):
    config = WorldConfig(robots=2, groups=1, horizon_is="failure")
    state, reward = make_state(config, [(0, 0), (1, 0)], [(4, 0)]), np.zeros(1, REAL)
    state.goal_distance_m[0], state.steps[0] = 5.0, 500
    make_method(config).reward(state, ALL, np.array([Outcome.TIMEOUT], np.int8), reward)
    assert reward[0] == -1


def test_an_equal_distance_is_not_closer(make_state):
    config = WorldConfig(robots=2, groups=1)
    state = make_state(config, [(0, 0), (1, 0)], [(4, 0)])
    state.goal_distance_m[0], state.steps[0] = 4.0, 1
    reward = np.zeros(1, REAL)
    make_method(config).reward(state, ALL, np.zeros(1, np.int8), reward)
    assert reward[0] == -1


@pytest.mark.parametrize(
    ("steps", "expected"), [(499, Outcome.RUNNING), (500, Outcome.TIMEOUT), (501, Outcome.TIMEOUT)]
)
def test_the_clock_ends_what_runs(steps, expected, make_state):
    config = WorldConfig(robots=2, groups=1)
    state, out = make_state(config, [(0, 0), (1, 0)], [(40, 0)]), np.zeros(1, np.int8)
    state.steps[0] = steps
    make_method(config).outcome(state, ALL, out)
    assert Outcome(out[0]) is expected


@pytest.mark.parametrize(
    ("mate", "goal", "expected"),
    [((1, 0), (0.5, 0), Outcome.GOAL), ((3, 0), (40, 0), Outcome.LOST), ((0.1, 0), (40, 0), Outcome.COLLISION)],
)
def test_the_task_comes_before_the_clock(mate, goal, expected, make_state):
    config = WorldConfig(robots=2, groups=1)
    state, out = make_state(config, [(0, 0), mate], [goal]), np.zeros(1, np.int8)
    state.steps[0] = 500
    make_method(config).outcome(state, ALL, out)
    assert Outcome(out[0]) is expected


def test_every_method_has_a_name_that_the_configuration_takes():
    labels = {name: make_method(WorldConfig(method=name)).label for name in METHODS.built_in}
    assert labels == {"sensor": "M_sensor", "in": "M_IN", "out": "M_OUT"}
