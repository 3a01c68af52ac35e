"""One step of ORCA against the reference RVO2 (pyrvo), and what its velocities must obey."""

import numpy as np
import pyrvo
import pytest

from sim_core.neighbours import find_neighbours
from sim_core.orca import orca_params, orca_velocity

REAL = np.float32
TIME_STEP_S, HORIZON_S, RADIUS_M, MAX_SPEED_M_S = 0.05, 2.0, 0.2, 1.0
MAX_NEIGHBOURS, RANGE_M = 10, 1.5
PARAMS = orca_params(RADIUS_M, HORIZON_S, TIME_STEP_S, MAX_SPEED_M_S, REAL)
KINDS = ("sparse", "jammed", "overlapping", "head-on", "at rest")
SCENES_PER_KIND = 200


def random_scene(kind, rng):
    """Positions, velocities and preferred velocities, each `[n, 2]` float32."""
    n = int(rng.integers(2, 61))
    spacing_m = {"sparse": 1.0, "jammed": 0.42, "overlapping": 0.2, "head-on": 0.6, "at rest": 0.45}[kind]
    pos = rng.uniform(0, spacing_m * np.sqrt(n), (n, 2))
    if kind == "jammed":  # a shaken grid: everybody touches somebody
        pos = 0.42 * np.stack(np.divmod(np.arange(n), 8), axis=1) + rng.uniform(-0.02, 0.02, (n, 2))
    vel = rng.normal(0, 0.5, (n, 2))
    vel *= np.minimum(1, MAX_SPEED_M_S / np.linalg.norm(vel, axis=1, keepdims=True))
    pref = rng.normal(0, 0.7, (n, 2))
    if kind == "head-on":  # two walls that run into each other
        side = np.where(np.arange(n) % 2, 1.0, -1.0)
        pos = np.stack([side * rng.uniform(0.25, 0.8, n), pos[:, 1]], axis=1)
        vel = np.stack([-side, rng.normal(0, 1e-3, n)], axis=1)
        pref = np.stack([-1.2 * side, np.zeros(n)], axis=1)
    if kind == "at rest":
        vel[:] = 0
    return pos.astype(REAL), vel.astype(REAL), pref.astype(REAL)


def reference_step(pos, vel, pref):
    """RVO2's new velocities `[n, 2]`."""
    sim = pyrvo.RVOSimulator(TIME_STEP_S, RANGE_M, MAX_NEIGHBOURS, HORIZON_S, HORIZON_S, RADIUS_M, MAX_SPEED_M_S)
    for i in range(len(pos)):
        sim.add_agent(tuple(map(float, pos[i])))
        sim.set_agent_velocity(i, tuple(map(float, vel[i])))
        sim.set_agent_pref_velocity(i, tuple(map(float, pref[i])))
    sim.do_step()
    new = [sim.get_agent_velocity(i) for i in range(len(pos))]
    return np.array([[v.x, v.y] for v in new])


def own_step(pos, vel, pref):
    """The kernels' new velocities `[n, 2]` and each robot's half-planes `[count, 4]`."""
    pos_x, pos_y = np.ascontiguousarray(pos.T)
    vel_x, vel_y = np.ascontiguousarray(vel.T)
    neighbours, distances = np.zeros(MAX_NEIGHBOURS, np.int32), np.zeros(MAX_NEIGHBOURS, REAL)
    lines, projected = np.zeros((MAX_NEIGHBOURS, 4), REAL), np.zeros((MAX_NEIGHBOURS, 4), REAL)
    new, planes = np.zeros_like(pos), []
    for i in range(len(pos)):
        count = find_neighbours(i, pos_x, pos_y, -1, REAL(RANGE_M) ** 2, neighbours, distances)
        new[i] = orca_velocity(
            i, pos_x, pos_y, vel_x, vel_y, neighbours, count, pref[i, 0], pref[i, 1], lines, projected, PARAMS
        )
        planes.append(lines[:count].copy())
    return new, planes


def has_tie(pos):
    """Per robot, whether two of the distances that fill or bound its neighbour list are equal.

    RVO2 orders equal distances by its tree, the worlds by index; the order of the half-planes decides
    which of several equally good velocities is taken, so only such robots may differ.
    """
    delta = pos[:, None] - pos[None]
    dist_sq = np.sort(delta[..., 0] * delta[..., 0] + delta[..., 1] * delta[..., 1], axis=1)[:, 1:]
    return (np.diff(dist_sq[:, : MAX_NEIGHBOURS + 1], axis=1) == 0).any(axis=1)


def worst_violation(planes, velocity):
    """How far `velocity` lies outside the worst half-plane, m/s (negative: inside all)."""
    lines = planes.astype(np.float64)
    gap = lines[:, 2] * (lines[:, 1] - velocity[1]) - lines[:, 3] * (lines[:, 0] - velocity[0])
    return gap.max(initial=-np.inf)


@pytest.mark.parametrize("kind", KINDS)
def test_one_step_matches_rvo2(kind):
    rng = np.random.default_rng(KINDS.index(kind))
    compared, ties, too_fast, infeasible = 0, 0, 0, 0
    for _ in range(SCENES_PER_KIND):
        pos, vel, pref = random_scene(kind, rng)
        new, planes = own_step(pos, vel, pref)
        expected = reference_step(pos, vel, pref)
        clear, speed = ~has_tie(pos), np.linalg.norm(expected, axis=1, keepdims=True)
        # RVO2's third program can exceed the speed limit (seen: 4 m/s); the worlds' may not.
        limited = np.where(speed > MAX_SPEED_M_S, expected / speed * MAX_SPEED_M_S, expected)
        np.testing.assert_allclose(new[clear], limited[clear], atol=1e-4, rtol=0)
        obeys = clear & (speed[:, 0] <= MAX_SPEED_M_S + 1e-6)
        np.testing.assert_array_equal(new[obeys], expected[obeys])  # the same arithmetic, not merely close
        compared += obeys.sum()
        ties += (~clear).sum()
        too_fast += (speed > MAX_SPEED_M_S + 1e-4).sum()
        infeasible += sum(worst_violation(p, v) > 1e-4 for p, v in zip(planes, expected, strict=True))
    assert compared > 5000 and ties < 0.01 * compared and too_fast < 0.03 * compared
    if kind in ("jammed", "overlapping"):
        assert infeasible > 100  # the third program is really at work


@pytest.mark.parametrize("kind", KINDS)
def test_velocities_obey_the_half_planes_and_the_speed_limit(kind):
    rng = np.random.default_rng(100 + KINDS.index(kind))
    feasible = 0
    for _ in range(60):
        pos, vel, pref = random_scene(kind, rng)
        new, planes = own_step(pos, vel, pref)
        assert np.all(np.linalg.norm(new.astype(np.float64), axis=1) <= MAX_SPEED_M_S + 1e-5)
        for lines, velocity in zip(planes, new, strict=True):
            if exists_permitted_velocity(lines):
                feasible += 1
                assert worst_violation(lines, velocity) <= 1e-5
    assert feasible > (5 if kind == "overlapping" else 100)


def exists_permitted_velocity(lines):
    """Whether a point of a fine grid over the speed disc lies inside all half-planes by a margin."""
    axis = np.linspace(-MAX_SPEED_M_S, MAX_SPEED_M_S, 41)
    x, y = (grid.ravel()[:, None] for grid in np.meshgrid(axis, axis))
    gap = lines[:, 2] * (lines[:, 1] - y) - lines[:, 3] * (lines[:, 0] - x)
    return bool(((gap < -1e-3).all(axis=1) & (x[:, 0] ** 2 + y[:, 0] ** 2 < MAX_SPEED_M_S**2)).any())


def test_alone_a_robot_takes_its_preferred_velocity_up_to_the_limit():
    pos, vel = np.zeros((1, 2), REAL), np.zeros((1, 2), REAL)
    new, _ = own_step(pos, vel, np.array([[0.3, -0.4]], REAL))
    np.testing.assert_array_equal(new, np.array([[0.3, -0.4]], REAL))
    new, _ = own_step(pos, vel, np.array([[3.0, -4.0]], REAL))
    np.testing.assert_allclose(new, [[0.6, -0.8]], atol=1e-6)


@pytest.mark.parametrize("distance_m", [0.5, 1.0, 1.4])
def test_two_that_meet_head_on_share_the_work(distance_m):
    # Closed form: relative speed 2 may fall to (distance - combined radius) / horizon, half by each.
    pos = np.array([[0, 0], [distance_m, 0]], REAL)
    vel = np.array([[1, 0], [-1, 0]], REAL)
    new, planes = own_step(pos, vel, vel)
    np.testing.assert_allclose(new[1], -new[0], atol=1e-5)
    assert worst_violation(planes[0], [1, 0]) > 0
    assert np.linalg.norm(new[0] - vel[0]) < np.linalg.norm([1 - (distance_m - 0.4) / HORIZON_S / 2, 0]) + 1e-5


@pytest.mark.parametrize("velocity", [(0.0, 0.0), (0.4, -0.3)])
@pytest.mark.parametrize("place", [(0.0, 0.0), (3.7, -5.1)])
def test_coincident_robots_part_in_opposite_directions(place, velocity):
    pos, vel = np.array([place, place], REAL), np.array([velocity, velocity], REAL)
    new, planes = own_step(pos, vel, vel)
    assert np.isfinite(new).all() and all(np.isfinite(lines).all() for lines in planes)
    assert (new[0] - new[1])[0] > 0.5
    lines = np.array([planes[0][0], planes[1][0]])
    np.testing.assert_allclose(lines[0, 2:], -lines[1, 2:])
    if velocity == (0.0, 0.0):
        np.testing.assert_allclose(new[0], -new[1])


@pytest.mark.parametrize("count", [3, 11])
def test_a_heap_of_coincident_robots_stays_finite(count):
    pos, vel = np.zeros((count, 2), REAL), np.zeros((count, 2), REAL)
    new, _ = own_step(pos, vel, np.ones((count, 2), REAL))
    assert np.isfinite(new).all()
    assert np.all(np.linalg.norm(new, axis=1) <= MAX_SPEED_M_S + 1e-5)


@pytest.mark.parametrize("offset_m", [1e-3, 1e-6, 1e-12, 1e-19, 1e-22, 1e-30, 1e-38, 1e-44])
def test_nearly_coincident_robots_keep_unit_directions(offset_m):
    # The squares of such offsets underflow: a direction must neither blow up nor shrink.
    pos = np.array([[0, 0], [offset_m, -0.7 * offset_m]], REAL)
    new, planes = own_step(pos, np.zeros((2, 2), REAL), np.zeros((2, 2), REAL))
    assert np.isfinite(new).all()
    for lines in planes:
        np.testing.assert_allclose(np.hypot(lines[:, 2], lines[:, 3]), 1, atol=1e-5)
    np.testing.assert_allclose(new[0], -new[1], atol=1e-6)
