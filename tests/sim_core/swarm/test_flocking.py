"""FL-ORCA's rules by hand: every state, term, weight and threshold of the published rules.

In every scene robot 0 of group 0 stands at the origin and its goal lies far along +x, so that angles from the goal
direction are polar angles. Robots that a scene does not need stand far away from all others.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from sim_core.config import WorldConfig
from sim_core.swarm.flock_rules import FOLLOWER, SINGLE_GROUP, TURN_RIGHT, VISION_FREE, flock_params
from tests.sim_core.kernels import terms_of_robot_0, weighted_sum_of

REAL = np.float32
GOALS = [(20.0, 0.0), (-200.0, 0.0), (0.0, 200.0)]
ROBOTS, GROUPS = 4, 3
CONFIG = WorldConfig(robots=ROBOTS, groups=GROUPS, separation_noise=0.0)
MATE, MATE_2, OTHER, OTHER_2, THIRD = 1, 2, 4, 5, 8


def polar(distance_m, angle_deg):
    """Position at a distance and an anticlockwise angle from the goal direction."""
    return np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))]) * distance_m


def positions(**robots):
    """Positions `[12, 2]`: robot 0 at the origin, named robots at the given positions, the others far away."""
    pos = np.stack([np.full(12, 100.0), 10.0 * np.arange(12)], axis=1)
    pos[0] = 0
    for name, position in robots.items():
        pos[globals()[name]] = position
    return pos


def unit(vector):
    """The vector, scaled to length 1 if it is longer."""
    return np.asarray(vector) / max(1.0, np.linalg.norm(vector))


RIGHT_Z = np.array([0.0, -20.0])  # the goal direction (20, 0), rotated clockwise by 90 degrees


def check(flock, state, total, leader=-1, robot=0):
    """Robot `robot` is in `state`, follows `leader`, and prefers the velocity `total`, clipped to length 1."""
    assert flock.states[robot] == state
    assert (flock.leaders[robot] if flock.leaders[robot] >= 0 else -1) == leader
    np.testing.assert_allclose(flock.velocity[robot], unit(total), atol=2e-5)


def test_a_robot_alone_goes_to_its_goal(make_flock):
    check(make_flock(CONFIG, positions(), GOALS), SINGLE_GROUP, [1, 0])


def test_single_group_adds_cohesion_and_alignment(make_flock):
    vel = np.zeros((12, 2))
    vel[MATE], vel[MATE_2] = (0.4, 0.8), (0.2, -0.2)
    flock = make_flock(CONFIG, positions(MATE=(-0.6, 0.8), MATE_2=(-0.2, 0.4)), GOALS, vel)
    check(flock, SINGLE_GROUP, np.array([1, 0]) + [-0.4, 0.6] + [0.3, 0.3])


def test_vision_free_weighs_all_terms(make_flock):
    vel = np.zeros((12, 2))
    vel[MATE], vel[OTHER] = (0.0, 0.1), (-1, 0)  # alignment must ignore another group
    mate, other = polar(0.02, 120), polar(0.3, 40)
    flock = make_flock(CONFIG, positions(MATE=mate, OTHER=other), GOALS, vel)
    check(flock, VISION_FREE, 15 * mate - 0.5 * other + 5 * np.array([0, 0.1]) + [0.35, 0])


def test_vision_free_alone_is_shorter_than_full_speed(make_flock):
    other = polar(0.3, -40)
    flock = make_flock(CONFIG, positions(OTHER=other), GOALS)
    assert np.linalg.norm(flock.velocity[0]) < 0.4
    check(flock, VISION_FREE, [0.35, 0] - 0.5 * other)


def test_follower_that_sees_another_group(make_flock):
    # OTHER blocks the view; MATE has a free view.
    mate, other = polar(0.1, 100), polar(0.3, -15)
    flock = make_flock(CONFIG, positions(MATE=mate, OTHER=other), GOALS)
    check(flock, FOLLOWER, (15 + 50) * mate - 0.5 * other, leader=MATE)


def test_follower_that_sees_no_other_group_adds_the_goal(make_flock):
    mate = polar(1.0, 15)  # blocks the view and has a free view itself
    flock = make_flock(CONFIG, positions(MATE=mate), GOALS)
    check(flock, FOLLOWER, np.array([1, 0]) + (10 + 50) * mate, leader=MATE)


def test_of_two_free_robots_the_one_nearer_the_goal_leads(make_flock):
    near, far = polar(0.3, 100), polar(0.5, 60)  # MATE is nearer to robot 0, MATE_2 is nearer to the goal
    flock = make_flock(CONFIG, positions(MATE=near, MATE_2=far, OTHER=polar(0.9, -15)), GOALS)
    check(flock, FOLLOWER, np.array([1, 0]) + 10 * (near + far) / 2 + 50 * far, leader=MATE_2)


def test_a_level_2_follower_follows_a_follower_and_is_not_followed(make_flock):
    # A queue towards the goal with 1 m gaps: only the first robot has a free view; each robot senses the next one.
    pos = positions(MATE=(1.0, 0), MATE_2=(2.0, 0))
    pos[3] = (-1.0, 0)
    flock = make_flock(CONFIG, pos, GOALS)
    assert flock.leaders[:4].tolist() == [MATE, MATE_2, -1, -1]
    assert flock.states[:4].tolist() == [FOLLOWER, FOLLOWER, SINGLE_GROUP, SINGLE_GROUP]
    check(flock, FOLLOWER, np.array([1, 0]) + 50 * np.array([1.0, 0]) + [0, 0], leader=MATE)
    check(flock, SINGLE_GROUP, [2, 0], robot=3)


def test_a_free_leader_is_preferred_to_a_follower_nearer_the_goal(make_flock):
    # MATE_2 has a free view and stands behind robot 0. MATE is nearer to the goal and follows robot 3.
    pos = positions(MATE=(1.2, 0.0), MATE_2=(-0.9, 1.0), OTHER=(1.3, 1.3), OTHER_2=(100, 300))
    pos[3] = (2.4, 0.0)
    flock = make_flock(CONFIG, pos, GOALS)
    assert flock.leaders[MATE] == 3 and flock.states[MATE_2] in (SINGLE_GROUP, VISION_FREE)
    assert flock.leaders[0] == MATE_2


def test_turn_right_because_the_robot_sees_another_group(make_flock):
    other = polar(0.3, 10)
    flock = make_flock(CONFIG, positions(OTHER=other), GOALS)
    check(flock, TURN_RIGHT, -0.5 * other + 15 * RIGHT_Z)


def test_turn_right_weighs_cohesion_and_alignment(make_flock):
    goals = [(1e-2, 0.0), *GOALS[1:]]  # z is as long as the goal distance: near the goal the other terms matter
    vel = np.zeros((12, 2))
    vel[MATE] = (0.3, 0.2)
    other, mate = polar(0.3, 10), np.array([-0.004, 0.002])
    flock = make_flock(CONFIG, positions(MATE=mate, OTHER=other), goals, vel)
    z = np.array([0, -1e-2])
    check(flock, TURN_RIGHT, 50 * mate - 0.5 * other + np.array([0.3, 0.2]) + 15 * z)


def test_turn_right_because_a_flockmate_sees_another_group(make_flock):
    # OTHER is out of robot 0's sight (0.789 m) but blocks its view. MATE's view is blocked too, and it sees OTHER_2.
    mate, other = polar(0.5, 30), polar(1.2, 12)
    flock = make_flock(CONFIG, positions(MATE=mate, OTHER=other, OTHER_2=mate + [0.7, 0]), GOALS)
    assert flock.states[MATE] == TURN_RIGHT and flock.leaders[MATE] == -1
    check(flock, TURN_RIGHT, np.array([1, 0]) + 15 * mate + 50 * RIGHT_Z)


def test_blocked_without_leader_or_other_group_in_sight_is_single_group(make_flock):
    flock = make_flock(CONFIG, positions(OTHER=polar(1.2, 0)), GOALS)
    check(flock, SINGLE_GROUP, [1, 0])


def test_a_neighbour_of_another_group_is_no_leader_and_causes_no_right_turn(make_flock):
    # OTHER has a free view of its own goal and sees robot 0's group. Both must not matter to robot 0.
    pos = positions(OTHER=polar(1.2, 0), OTHER_2=polar(1.3, 5))
    check(make_flock(CONFIG, pos, GOALS), SINGLE_GROUP, [1, 0])


def test_velocities_are_finite_at_the_goal_beside_coincident_robots(make_flock):
    goals = [(0.0, 0.0), *GOALS[1:]]
    for rules in ("published", "uniform"):
        config = WorldConfig(robots=ROBOTS, groups=GROUPS, flocking=rules)
        flock = make_flock(config, positions(MATE=(0, 0), OTHER=(0, 0), OTHER_2=(0.1, 0)), goals)
        assert np.isfinite(flock.velocity).all()
        assert np.linalg.norm(flock.velocity, axis=1).max() < 1 + 1e-5


@pytest.mark.parametrize(
    ("distance_m", "angle_deg", "seen"),
    [
        (0.788, 60, True), (0.790, 60, False), (0.5, 89.9, True), (0.5, 90.1, False),
        (0.5, -89.9, True), (0.5, -90.1, False), (0.3, 180, False),
    ],
)  # fmt: skip
def test_limits_of_sight(distance_m, angle_deg, seen, make_flock):
    position = polar(distance_m, angle_deg)
    assert make_flock(CONFIG, positions(OTHER=position), GOALS).states[0] == (VISION_FREE if seen else SINGLE_GROUP)
    assert make_flock(CONFIG, positions(MATE=position), GOALS).states[0] == SINGLE_GROUP  # the own group does not count


@pytest.mark.parametrize(
    ("distance_m", "angle_deg", "blocks"),
    [(1.4, 19.9, True), (1.4, 20.1, False), (1.4, -19.9, True), (1.4, -20.1, False), (1.49, 0, True), (1.51, 0, False)],
)
def test_limits_of_the_view(distance_m, angle_deg, blocks, make_flock):
    flock = make_flock(CONFIG, positions(MATE=polar(distance_m, angle_deg)), GOALS)
    assert flock.states[0] == (FOLLOWER if blocks else SINGLE_GROUP)


@pytest.mark.parametrize(("distance_m", "blocks"), [(2.62, True), (2.64, False)])
def test_the_view_range_limits_the_view_if_the_neighbour_range_is_larger(distance_m, blocks, make_flock):
    config = WorldConfig(robots=ROBOTS, groups=GROUPS, neighbour_range_m=4.0)
    flock = make_flock(config, positions(MATE=(distance_m, 0)), GOALS)
    assert flock.states[0] == (FOLLOWER if blocks else SINGLE_GROUP)


@pytest.mark.parametrize(
    ("distance_m", "angle_deg", "acts"),
    [(0.394, 44.9, True), (0.396, 44.9, False), (0.394, 45.1, False), (0.3, -44.9, True), (0.3, -45.1, False)],
)
def test_limits_of_separation(distance_m, angle_deg, acts, make_flock):
    other = polar(distance_m, angle_deg)
    flock = make_flock(CONFIG, positions(OTHER=other), GOALS)
    check(flock, VISION_FREE, [0.35, 0] - 0.5 * other * acts)


def terms_of(pos, vel=None, noise=0.0, config=CONFIG):
    """Robot 0's (cohesion, separation, alignment); all others are its neighbours."""
    vel = np.zeros((len(pos), 2)) if vel is None else vel
    return terms_of_robot_0(pos, vel, (20, 0), 1 + noise, flock_params(config, REAL), config.robots)


def test_terms_are_means_and_clipped():
    far = (0.5, -50.0)
    pos = [(0, 0), (0.2, 0.4), (0.4, -0.2), far, (0.2, 0.1), (0.1, -0.05), far, far]
    vel = [(9, 9), (0.3, 0), (0, 0.6), (0, 0), (7, 7), (7, 7), (7, 7), (7, 7)]
    cohesion, separation, alignment = terms_of(pos[:3] + [(0.3, 0.1)] + pos[4:6], vel[:6])
    np.testing.assert_allclose(cohesion, [0.3, 0.1], atol=1e-6)
    np.testing.assert_allclose(separation, [-0.15, -0.025], atol=1e-6)
    np.testing.assert_allclose(alignment, [0.1, 0.2], atol=1e-6)
    cohesion, separation, alignment = terms_of([(0, 0), (3, 4), (3, 4), (3, 4)], [(0, 0), (0, 3), (0, 3), (0, 3)])
    np.testing.assert_allclose([cohesion, separation, alignment], [[0.6, 0.8], [0, 0], [0, 1]], atol=1e-6)


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.2])
def test_noise_is_a_gain_of_the_separation_term_only(noise):
    pos, vel = [(0, 0), (0.2, 0.3), (0, 0.1), (0.1, 0), (0.2, 0.1)], [(0.5, 0)] * 5
    plain, noisy = terms_of(pos, vel), terms_of(pos, vel, noise)
    np.testing.assert_allclose(noisy, plain * [[1], [1 + noise], [1]], atol=1e-6)


def test_random_gains_are_uniform_between_1_and_1_2(make_flock):
    config = WorldConfig(robots=ROBOTS, groups=GROUPS)
    other, gains = polar(0.3, 40), []
    for seed in range(400):
        velocity = make_flock(config, positions(OTHER=other), GOALS, seed=seed * 7919).velocity[0]
        gain = (np.array([0.35, 0]) - velocity) / (0.5 * other)
        assert gain[0] == pytest.approx(gain[1], abs=1e-4)
        gains.append(gain[1])
    assert min(gains) > 1 - 1e-5 and max(gains) < 1.2 + 1e-5
    assert stats.kstest(gains, stats.uniform(1, 0.2).cdf).pvalue > 1e-3


TABLE = [
    # state, sees another group; weights of cohesion, separation, alignment, pref, leader, right (spec, section 2)
    (VISION_FREE, True, (15, 0.5, 5, 0.35, 0, 0)),
    (FOLLOWER, True, (15, 0.5, 0, 0, 50, 0)),
    (TURN_RIGHT, True, (50, 0.5, 1, 0, 0, 15)),
    (FOLLOWER, False, (10, 0, 0, 1, 50, 0)),
    (TURN_RIGHT, False, (15, 0, 2, 1, 0, 50)),
    (SINGLE_GROUP, False, (1, 0, 1, 1, 0, 0)),
]
UNIFORM = [
    (SINGLE_GROUP, (0.3, 1, 0.3, 1, 0, 0)),
    (VISION_FREE, (0.3, 1, 0.3, 1, 0, 0)),
    (FOLLOWER, (0.3, 1, 0.3, 0, 1, 0)),
    (TURN_RIGHT, (0.3, 1, 0.3, 0, 0, 1)),
]


@pytest.mark.parametrize(("state", "sees", "weights"), TABLE)
def test_published_weights(state, sees, weights):
    params, size = flock_params(CONFIG, REAL), REAL(1e-3)  # small, so that no sum is clipped to length 1
    for term in range(3):
        terms = [REAL(0)] * 6
        terms[2 * term + 1] = size
        x, y = weighted_sum_of(state, sees, terms, (0, 0), (0, 0), params)
        assert (x, y) == (0, pytest.approx(weights[term] * size))
    zeros = (REAL(0),) * 6
    x, y = weighted_sum_of(state, sees, zeros, (size, 0), (0, 0), params)
    assert (x, y) == (pytest.approx(weights[3] * size), pytest.approx(-weights[5] * size))
    x, y = weighted_sum_of(state, sees, zeros, (0, 0), (size, 0), params)
    assert (x, y) == (pytest.approx(weights[4] * size), 0)


@pytest.mark.parametrize("sees", [False, True])
@pytest.mark.parametrize(("state", "weights"), UNIFORM)
def test_uniform_weights(state, sees, weights):
    params = flock_params(WorldConfig(flocking="uniform"), REAL)
    zeros = [REAL(0)] * 6
    for term in range(3):
        terms = zeros.copy()
        terms[2 * term] = REAL(1e-3)
        x, y = weighted_sum_of(state, sees, terms, (0, 0), (0, 0), params)
        assert (x, y) == (pytest.approx(weights[term] * 1e-3), 0)
    for goal_m, pref in ((5.0, 1.0), (0.25, 1.0), (0.1, 0.4), (0.0, 0.0)):  # robots slow down within 0.25 m
        x, y = weighted_sum_of(state, sees, zeros, (goal_m, 0), (0, 0), params)
        assert (x, y) == (pytest.approx(weights[3] * pref), pytest.approx(-weights[5] * pref))
    x, y = weighted_sum_of(state, sees, zeros, (0, 0), (0, 0.3), params)
    assert (x, y) == (0, pytest.approx(weights[4]))  # a unit vector to the leader at any distance


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.permutations(range(4)),
    st.permutations(range(4)),
    st.sampled_from(["published", "uniform"]),
)
def test_the_order_of_robots_in_a_group_does_not_matter(make_flock, seed, first, second, rules):
    # Flags are computed in passes over the old state, so all robots see the same flags.
    config = WorldConfig(robots=ROBOTS, groups=GROUPS, separation_noise=0.0, flocking=rules)
    rng = np.random.default_rng(seed)
    pos, vel = rng.uniform(-1, 1, (12, 2)), rng.normal(0, 0.5, (12, 2))
    order = np.array([*first, *(4 + np.array(second)), *range(8, 12)])
    plain = make_flock(config, pos, GOALS, vel)
    permuted = make_flock(config, pos[order], GOALS, vel[order])
    np.testing.assert_array_equal(permuted.velocity, plain.velocity[order])
    np.testing.assert_array_equal(permuted.states, plain.states[order])
    np.testing.assert_array_equal(permuted.flags, plain.flags[order])
    leaders = np.where(permuted.leaders >= 0, order[permuted.leaders], -1)
    np.testing.assert_array_equal(leaders, plain.leaders[order])
