"""M_IN and M_OUT: the state matrix by hand and by numpy, Table 4.1, phi and the outcomes step by step."""

import dataclasses
import itertools
import math

import numpy as np
import pytest

from sim_core.checks import ConfigError
from sim_core.config import WorldConfig
from sim_core.methods import make_method
from sim_core.methods.apf import field_params, repulsion
from sim_core.methods.group_ellipses import observation_limit
from sim_core.outcomes import Outcome
from sim_core.worlds import WorldBatch

REAL = np.float32
ALL = np.ones(1, np.bool_)
METHOD_NAMES = ("in", "out")
FAR = (40.0, 40.0)


def observe(config, state):
    """The state matrix `[groups, columns]`."""
    method = make_method(config)
    out = np.full((1, *method.observation_shape), 99, method.observation_dtype)
    method.perceive(state, ALL, out)
    return out[0].reshape(config.groups, -1)


def by_numpy(config, pos, goals, learner):
    """The rows of the state matrix without u_apf, own group first and the others by number, in float64."""
    pos, own, rows = pos.astype(np.float64), learner // config.robots, []
    for group in [*range(own, config.groups), *range(own)]:
        members = [i for i in range(group * config.robots, (group + 1) * config.robots)]
        if not config.ellipse_counts_learner and learner in members:
            members.remove(learner)
        centre, covariance = pos[members].mean(axis=0), np.cov(pos[members].T)
        if config.ellipse_covariance == "diagonal":
            covariance = np.diag(np.diag(covariance))
        values, vectors = np.linalg.eigh(covariance)
        theta = (math.atan2(vectors[1, 1], vectors[0, 1]) + math.pi / 2 - 1e-9) % math.pi - math.pi / 2 + 1e-9
        axes = 0.5 * np.sqrt(5.991 * values) / (2 if config.ellipse_axes == "printed" else 1)
        rows.append([*axes, *(0.5 * (centre - pos[learner])), theta, *(0.15 * (goals[group] - pos[learner]))])
    return np.array(rows)


VARIANTS = list(itertools.product(("diagonal", "full"), ("confidence", "printed"), (False, True)))


@pytest.mark.parametrize(("covariance", "axes", "counts"), VARIANTS)
@pytest.mark.parametrize("method", METHOD_NAMES)
def test_the_state_matrix_matches_numpy(method, covariance, axes, counts, make_state):
    config = WorldConfig(
        method=method,
        robots=6,
        groups=4,
        ellipse_covariance=covariance,
        ellipse_axes=axes,
        ellipse_counts_learner=counts,
    )
    rng = np.random.default_rng(1)
    for _ in range(50):
        pos, goals = rng.uniform(-6, 6, (24, 2)).astype(REAL), rng.uniform(-6, 6, (4, 2)).astype(REAL)
        learner = int(rng.integers(24))
        found = observe(config, make_state(config, pos, goals, learner=learner))
        assert found.shape == (4, 9 if method == "in" else 7) and found.dtype == REAL
        np.testing.assert_allclose(found[:, :7], by_numpy(config, pos, goals, learner), atol=1e-4)


PAIRS = [(0, 0), (0, 1), (0, 3), (5, 0), (5, 2), (7, 1), (-2, 0), (-2, 2), (-4, 1)]
GOALS = [(1, 2), (3, 4), (5, 6)]


def test_a_row_by_hand(make_state):
    config = WorldConfig(method="out", robots=3, groups=3, ellipse_chi_square=4.0)
    state = make_state(config, PAIRS, GOALS, learner=3)
    rows = observe(config, state)
    # own: robots (5, 2) and (7, 1), variances 2 and 0.5; seen from (5, 0)
    expected = [0.5 * 2 * math.sqrt(0.5), 0.5 * 2 * math.sqrt(2), 0.5 * 1, 0.5 * 1.5, 0, 0.15 * -2, 0.15 * 4]
    np.testing.assert_allclose(rows[0], expected, atol=1e-6)
    # the next by number is group 2: (-2, 0), (-2, 2), (-4, 1), variances 4/3 and 1
    expected = [0.5 * 2, math.sqrt(4 / 3), 0.5 * (-8 / 3 - 5), 0.5 * 1, 0, 0, 0.15 * 6]
    np.testing.assert_allclose(rows[1], expected, atol=1e-6)
    # group 0: all at x = 0, y of 0, 1, 3
    expected = [0.5 * 0.01, math.sqrt(7 / 3), 0.5 * -5, 0.5 * 4 / 3, math.pi / 2, 0.15 * -4, 0.15 * 2]
    np.testing.assert_allclose(rows[2], expected, atol=1e-6)


@pytest.mark.parametrize("learner", [0, 3, 6])
def test_rows_begin_with_the_own_group(learner, make_state):
    for order in ("fixed", "nearest"):
        config = WorldConfig(method="out", robots=3, groups=3, group_order=order)
        rows = observe(config, make_state(config, PAIRS, GOALS, learner=learner))
        np.testing.assert_allclose(rows[0, 5:] / 0.15 + PAIRS[learner], GOALS[learner // 3], atol=1e-5)


def test_other_groups_come_nearest_first(make_state):
    rng, config = np.random.default_rng(2), WorldConfig(method="out", robots=3, groups=6, group_order="nearest")
    fixed = WorldConfig(method="out", robots=3, groups=6)
    for _ in range(50):
        pos, learner = rng.uniform(-6, 6, (18, 2)), int(rng.integers(18))
        state = make_state(config, pos, rng.uniform(-6, 6, (6, 2)), learner=learner)
        rows = observe(config, state)
        assert (np.diff(np.hypot(rows[1:, 2], rows[1:, 3])) >= 0).all()
        others = observe(fixed, state)
        np.testing.assert_array_equal(rows[0], others[0])
        np.testing.assert_array_equal(np.sort(rows, axis=0), np.sort(others, axis=0))  # the same rows


def test_equally_near_groups_keep_their_order(make_state):
    config = WorldConfig(method="out", robots=3, groups=4, group_order="nearest")
    pos = [(x + dx, y + dy) for x, y in ((0, 0), (4, 0), (0, 4), (-4, 0)) for dx, dy in ((-1, 1), (1, 1), (0, -2))]
    pos[0] = (0, 0)
    rows = observe(config, make_state(config, pos, [(0, 0)] * 4, learner=0))
    np.testing.assert_allclose(rows[1:, 2:4] / 0.5, [(4, 0), (0, 4), (-4, 0)], atol=1e-6)


def test_u_apf_of_each_group_or_of_all(make_state):
    pos = [(0, 0), (0.3, 0), (5, 0), (0, -0.3), (0, -9), (9, 9)]
    right, below = np.array(repulsion(0.3, 0.0, p := field_params(WorldConfig()))), np.array(repulsion(0.0, -0.3, p))
    for rows, expected in (("group", [right, below]), ("all", [right + below] * 2)):
        config = WorldConfig(method="in", robots=3, groups=2, apf_rows=rows)
        found = observe(config, make_state(config, pos, [(0, 0)] * 2, learner=0))
        np.testing.assert_allclose(found[:, 7:], expected, atol=1e-5)


@pytest.mark.parametrize("method", METHOD_NAMES)
def test_a_shift_changes_nothing_and_a_quarter_turn_turns(method, make_state):
    """A quarter turn swaps the axes, so that the diagonal covariance turns too; any turn does with the full one."""
    rng = np.random.default_rng(4)
    pos, goals = rng.uniform(-3, 3, (12, 2)), rng.uniform(-3, 3, (3, 2))
    for covariance, turn in (("diagonal", math.pi / 2), ("full", math.pi / 2), ("full", 0.7)):
        config = WorldConfig(method=method, robots=4, groups=3, ellipse_covariance=covariance, apf_range_m=1.5)
        rows = observe(config, make_state(config, pos, goals, learner=5))
        shifted = observe(config, make_state(config, pos + (7, -3), goals + (7, -3), learner=5))
        np.testing.assert_allclose(shifted, rows, atol=2e-5)
        matrix = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
        turned = observe(config, make_state(config, pos @ matrix, goals @ matrix, learner=5))
        np.testing.assert_allclose(turned[:, :2], rows[:, :2], atol=1e-5)
        for pair in ([2, 3], [5, 6], [7, 8])[: 3 if method == "in" else 2]:
            np.testing.assert_allclose(turned[:, pair], rows[:, pair] @ matrix, atol=1e-5)
        np.testing.assert_allclose(np.sin(turned[:, 4] - rows[:, 4] - turn), 0, atol=1e-4)


def test_only_masked_worlds_are_perceived(make_state):
    config = WorldConfig(method="out", robots=3, groups=1)
    worlds, out = WorldBatch(config, 3), np.full((3, 7), 99, REAL)
    worlds.reset()
    worlds.method.perceive(worlds.state, np.array([False, True, False]), out)
    assert (out[[0, 2]] == 99).all() and (out[1] != 99).all()


@pytest.mark.parametrize("method", METHOD_NAMES)
def test_no_observation_reaches_the_limit(method):
    config = WorldConfig(method=method, robots=3, groups=2, arena_radius_m=2.0, horizon_steps=300)
    worlds, largest = WorldBatch(config, 8), 0.0
    worlds.reset()
    for _ in range(300):  # straight on, to where the robot is farthest from all the others
        largest = max(largest, np.abs(worlds.step(np.arange(8)).observation).max())
    assert largest < worlds.method.observation_limit < 30 * largest
    assert worlds.method.observation_limit == observation_limit(config)


SQUARE = [(1, 1), (1, -1), (-1, 1), (-1, -1)]


def scene(make_state, at, others, method="out", **settings):
    """(config, state): the learning robot at `at`, its four mates on a square around (0, 0), five robots `others`."""
    config = WorldConfig(**({"method": method, "robots": 5, "groups": 2} | settings))
    return config, make_state(config, [at, *SQUARE, *others], [FAR, FAR], learner=0)


@pytest.mark.parametrize("method", METHOD_NAMES)
def test_rows_without_a_group_are_zeros(method, make_state):
    rng = np.random.default_rng(4)
    config = WorldConfig(method=method, robots=4, groups=3)
    padded = dataclasses.replace(config, group_rows=8)
    state = make_state(config, rng.normal(size=(12, 2)), rng.normal(size=(3, 2)), learner=5)
    rows = make_method(padded)
    out = np.full((1, *rows.observation_shape), 99, rows.observation_dtype)
    rows.perceive(state, ALL, out)
    seen = out[0].reshape(8, -1)
    np.testing.assert_array_equal(seen[:3], observe(config, state))
    assert (seen[3:] == 0).all() and (seen[:3, 0] > 0).all(), "an absent row is told by its half-axis"
    assert len(rows.observation_names(padded)) == out.size
    with pytest.raises(ConfigError, match="group_rows must be 0 or at least groups \\(3\\), not 2"):
        dataclasses.replace(config, group_rows=2)


AWAY = [(20, 20 + i) for i in range(5)]
NEAR_6 = [(6, 1), *AWAY[1:]]
REACH = math.sqrt(5.991 * 4 / 3)  # half-axes of the square: variances 4/3


def step(config, state):
    """Outcome and reward of the state as a step's result."""
    method, outcome, reward = make_method(config), np.zeros(1, np.int8), np.zeros(1, REAL)
    state.steps[0] += 1
    method.outcome(state, ALL, outcome)
    method.reward(state, ALL, outcome, reward)
    return Outcome(outcome[0]), float(reward[0])


@pytest.mark.parametrize("method", METHOD_NAMES)
def test_table_4_1_step_by_step(method, make_state):
    config, state = scene(make_state, (0, 0), AWAY, method, reward_scale=3.0, outside_limit_steps=3)
    assert step(config, state) == (Outcome.RUNNING, pytest.approx(0.03))
    outside, inside = (REACH + 0.01, 0), (REACH - 0.01, 0)
    plan = [outside, outside, inside, outside, outside, outside]
    expected = [(Outcome.RUNNING, -0.03)] * 2 + [(Outcome.RUNNING, 0.03)] + [(Outcome.RUNNING, -0.03)] * 2
    expected.append((Outcome.LOST, -3.0))
    counts, total = [1, 2, 0, 1, 2, 3], 0.03
    for place, (outcome, reward), count in zip(plan, expected, counts, strict=True):
        state.pos_x[0, 0], state.pos_y[0, 0] = place
        assert step(config, state) == (outcome, pytest.approx(reward))
        assert state.outside_steps[0] == count
        total += reward
        assert state.episode_return[0] == pytest.approx(total)


@pytest.mark.parametrize("method", METHOD_NAMES)
def test_progress_is_rewarded_inside_only(method, make_state):
    config, state = scene(make_state, (0, 0), AWAY, method, reward_scale=3.0, ellipse_reward="progress")
    state.goal_x[0, 0], state.goal_y[0, 0], state.goal_distance_m[0] = 40.0, 0.0, 40.0
    for x, reward in ((0.1, 0.03), (0.1, -0.03), (0.05, -0.03), (0.2, 0.03), (REACH + 0.01, -0.03), (0.3, -0.03)):
        state.pos_x[0, 0] = x  # closer; as near; farther; closer; closer but outside; inside but farther
        assert step(config, state) == (Outcome.RUNNING, pytest.approx(reward))


@pytest.mark.parametrize(
    ("at", "others", "expected"),
    [
        ((6, 0), AWAY, Outcome.LOST),  # senses nobody
        ((6, 0), NEAR_6, Outcome.CAPTURED),  # senses a robot of another group, and none of its own
        ((2.2, 2.9), AWAY, Outcome.LOST),
        ((2.1, 1.95), [(2.1, 2.4), *AWAY[1:]], Outcome.LOST),  # senses one of either
        ((2.8, 0), AWAY, Outcome.RUNNING),  # inside
    ],
)
def test_lost_and_captured_at_phi(at, others, expected, make_state):
    config, state = scene(make_state, at, others, outside_limit_steps=4)
    for _ in range(3):
        assert step(config, state)[0] is Outcome.RUNNING
    outcome, reward = step(config, state)
    assert outcome is expected
    assert reward == pytest.approx(0.01 if expected is Outcome.RUNNING else -1.0)


@pytest.mark.parametrize("method", METHOD_NAMES)
def test_a_lost_robot_may_end_the_episode_before_phi(method, make_state):
    """Table 4.1's row "Lost / Collision": no own robot within R2, whatever the ellipse."""
    settings = {"outside_limit_steps": 100, "lost_ends_episode": True, "ellipse_axes": "printed"}
    config, state = scene(make_state, (2.0, 1.0), AWAY, method, **settings)
    mates = np.hypot(state.pos_x[0, 1 : config.robots] - 2.0, state.pos_y[0, 1 : config.robots] - 1.0)
    assert mates.min() < config.outer_radius_m
    assert step(config, state)[0] is Outcome.RUNNING and state.outside_steps[0] == 1  # outside, but it senses a mate
    for others, expected in ((AWAY, Outcome.LOST), (NEAR_6, Outcome.CAPTURED)):
        config, state = scene(make_state, (6, 0), others, method, **settings)
        assert step(config, state) == (expected, -1)
        config, state = scene(make_state, (6, 0), others, method, outside_limit_steps=100)
        assert step(config, state)[0] is Outcome.RUNNING
    config, state = scene(make_state, (6, 0), [(6.1, 0), *AWAY[1:]], method, **settings)
    assert step(config, state) == (Outcome.COLLISION, -1)


AROUND_6 = [(6.5, 0.5), (6.5, -0.5), (5.3, 0), *AWAY[3:]]


@pytest.mark.parametrize("method", ["sensor", *METHOD_NAMES])
@pytest.mark.parametrize(("others", "expected"), [(NEAR_6, Outcome.LOST), (AROUND_6, Outcome.CAPTURED)])
def test_captured_among_others_or_surrounded_by_them(method, others, expected, make_state):
    for captured_is, outcome in (("among", Outcome.CAPTURED), ("surrounded", expected)):
        config, state = scene(make_state, (6, 0), others, method, outside_limit_steps=1, captured_is=captured_is)
        assert step(config, state)[0] is outcome


def test_an_own_robot_in_sight_is_not_captured(make_state):
    config, state = scene(make_state, (0, 0), AWAY, outside_limit_steps=1, ellipse_axes="printed")
    state.pos_x[0, 0], state.pos_y[0, 0] = 2.0, 1.0  # half-axes of 1.41, a mate at 1 m
    state.pos_x[0, 5], state.pos_y[0, 5] = 2.0, 2.0
    assert step(config, state)[0] is Outcome.LOST
    state.pos_x[0, 1] = -1.0  # that mate goes elsewhere
    state.pos_x[0, 2] = -1.0
    assert step(config, state)[0] is Outcome.CAPTURED


def test_collision_and_goal_come_before_phi(make_state):
    config, state = scene(make_state, (6, 0), [(6.1, 0), *AWAY[1:]], outside_limit_steps=1)
    assert step(config, state) == (Outcome.COLLISION, -1)
    config, state = scene(make_state, (3, 0), AWAY, outside_limit_steps=1, outer_radius_m=2.0)
    state.goal_x[0, 0], state.goal_y[0, 0] = 0, 0
    assert step(config, state) == (Outcome.GOAL, 1) and state.outside_steps[0] == 1


def test_phi_comes_before_the_clock(make_state):
    config, state = scene(make_state, (6, 0), AWAY, outside_limit_steps=1)
    state.steps[0] = 499
    assert step(config, state)[0] is Outcome.LOST


@pytest.mark.parametrize(("horizon_is", "expected"), [("method", -1.0), ("failure", -1.0), ("cut", 0.01)])
def test_the_horizon_fails_unless_it_is_a_cut(horizon_is, expected, make_state):
    config, state = scene(make_state, (0, 0), AWAY, horizon_is=horizon_is)
    state.steps[0] = 498
    assert step(config, state) == (Outcome.RUNNING, pytest.approx(0.01))
    assert step(config, state) == (Outcome.TIMEOUT, pytest.approx(expected))


def test_a_restart_forgets_the_steps_outside():
    config = WorldConfig(method="out", outside_limit_steps=50)
    worlds = WorldBatch(config, 2)
    worlds.reset()
    worlds.state.outside_steps[:] = 7
    worlds.reset(np.array([True, False]))
    assert worlds.state.outside_steps.tolist() == [0, 7]
    saved = worlds.get_state()
    other = WorldBatch(config, 2)
    other.set_state(saved)
    assert other.state.outside_steps.tolist() == [0, 7]
