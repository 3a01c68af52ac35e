"""ORCA's linear programs against an enumeration of all candidate points and scipy's SLSQP, in float64."""

import numpy as np
import pytest
from scipy import optimize

from sim_core.orca import orca_params
from tests.sim_core.half_planes import closest_permitted, least_violation, normals_and_offsets, violation
from tests.sim_core.kernels import second_program, third_program

LIMIT = 1.3
PARAMS = orca_params(0.2, 2.0, 0.05, LIMIT, np.float64)
ATOL = 1e-6


def random_lines(rng, count, spread):
    """Half-planes `[count, 4]` with points of standard deviation `spread`; some are parallel or antiparallel."""
    angle = rng.uniform(-np.pi, np.pi, count)
    if count > 2 and rng.random() < 0.3:
        angle[1] = angle[0] + np.pi * rng.integers(2)
    return np.column_stack([rng.normal(0, spread, (count, 2)), np.cos(angle), np.sin(angle)])


def solve(lines, opt, direction_opt=False):
    """The second program's (failed line, velocity)."""
    return second_program(lines, opt, direction_opt, PARAMS)


def relax(lines, failed, v):
    """The third program's velocity."""
    return third_program(lines, failed, v, PARAMS)


def test_second_program_finds_the_closest_permitted_velocity():
    rng = np.random.default_rng(0)
    feasible, borderline = 0, 0
    for _ in range(300):
        lines = random_lines(rng, int(rng.integers(1, 11)), rng.choice([0.2, 0.6, 1.5]))
        opt = rng.normal(0, 1.0, 2)
        margin = -least_violation(lines, LIMIT)
        if abs(margin) < 1e-6:
            borderline += 1
            continue
        failed, v = solve(lines, opt)
        assert (failed == len(lines)) == (margin > 0)
        if margin > 0:
            feasible += 1
            np.testing.assert_allclose(v, closest_permitted(lines, LIMIT, opt), atol=ATOL)
    assert 60 < feasible < 250 and borderline < 5


def test_the_failed_line_is_the_first_that_makes_the_program_infeasible():
    rng = np.random.default_rng(1)
    failures = 0
    for _ in range(300):
        lines, opt = random_lines(rng, 8, 0.8), rng.normal(0, 1.0, 2)
        failed, v = solve(lines, opt)
        if failed == len(lines) or abs(least_violation(lines[: failed + 1], LIMIT)) < 1e-6:
            continue
        failures += 1
        assert least_violation(lines[: failed + 1], LIMIT) > 0
        if failed > 0:
            np.testing.assert_allclose(v, closest_permitted(lines[:failed], LIMIT, opt), atol=ATOL)
    assert failures > 100


def test_direction_optimisation_finds_the_farthest_permitted_velocity():
    rng = np.random.default_rng(2)
    feasible = 0
    for _ in range(300):
        lines, angle = random_lines(rng, int(rng.integers(1, 8)), 0.4), rng.uniform(-np.pi, np.pi)
        direction = np.array([np.cos(angle), np.sin(angle)])
        failed, v = solve(lines, direction, direction_opt=True)
        if failed < len(lines):
            continue
        feasible += 1
        far = closest_permitted(lines, LIMIT, 1e4 * direction)  # the closest to a distant point
        assert direction @ v == pytest.approx(direction @ far, abs=1e-3)
        assert violation(lines, v) < ATOL and np.linalg.norm(v) < LIMIT + ATOL
    assert feasible > 100


def test_third_program_minimises_the_largest_violation():
    rng = np.random.default_rng(3)
    infeasible = 0
    for _ in range(300):
        lines = random_lines(rng, int(rng.integers(2, 11)), rng.choice([0.6, 1.5, 3.0]))
        failed, v = solve(lines, rng.normal(0, 1.0, 2))
        if failed == len(lines):
            continue
        infeasible += 1
        v = relax(lines, failed, v)
        assert np.linalg.norm(v) < LIMIT + ATOL
        assert violation(lines, v) == pytest.approx(least_violation(lines, LIMIT), abs=1e-5)
    assert infeasible > 100


def test_both_programs_agree_with_slsqp():
    rng = np.random.default_rng(4)
    counts = [0, 0]
    disc = {"type": "ineq", "fun": lambda z: LIMIT**2 - z[0] ** 2 - z[1] ** 2}
    for _ in range(120):
        lines, opt = random_lines(rng, 4, 0.7), rng.normal(0, 1.0, 2)
        normal, offset = normals_and_offsets(lines)
        failed, v = solve(lines, opt)
        if failed == len(lines):
            planes = {"type": "ineq", "fun": lambda z, n=normal, o=offset: n @ z - o}
            found = optimize.minimize(
                lambda z, opt=opt: np.sum((z - opt) ** 2), v * 0.9, method="SLSQP", constraints=[disc, planes]
            )
            error = np.abs(v - found.x).max()
        else:
            v = relax(lines, failed, v)
            planes = {"type": "ineq", "fun": lambda z, n=normal, o=offset: n @ z[:2] - o + z[2]}
            found = optimize.minimize(lambda z: z[2], [0, 0, 5], method="SLSQP", constraints=[disc, planes])
            error = abs(violation(lines, v) - found.fun)
        if found.success:
            counts[failed < len(lines)] += 1
            assert error < 1e-3
    assert min(counts) > 15


def test_antiparallel_half_planes_without_a_common_point_are_violated_equally():
    lines = np.array([[0.0, -0.6, -1.0, 0.0], [0.0, 0.2, 1.0, 0.0]])  # y <= -0.6 and y >= 0.2
    failed, v = solve(lines, np.array([0.3, 0.9]))
    assert failed == 1
    v = relax(lines, failed, v)
    assert v[1] == pytest.approx(-0.2) and np.isfinite(v).all()


@pytest.mark.parametrize("copies", [2, 5])
def test_copies_of_a_half_plane_change_nothing(copies):
    lines = np.tile([[0.0, 0.5, 1.0, 0.0]], (copies, 1))  # y >= 0.5
    failed, v = solve(lines, np.array([0.1, -1.0]))
    assert failed == copies
    np.testing.assert_allclose(v, [0.1, 0.5])


def test_a_half_plane_outside_the_speed_disc_is_violated_least():
    lines = np.array([[0.0, 5.0, 1.0, 0.0]])  # y >= 5
    failed, v = solve(lines, np.array([0.5, 0.0]))
    assert failed == 0
    np.testing.assert_allclose(relax(lines, failed, v), [0.0, LIMIT], atol=1e-9)


@pytest.mark.parametrize("angle", [1e-7, 1e-6, 1e-4])
def test_velocities_of_nearly_parallel_half_planes_are_finite(angle):
    lines = np.array([[0.0, 0.9, 1.0, 0.0], [0.0, -0.9, -np.cos(angle), np.sin(angle)], [0.0, 0.91, 1.0, angle]])
    failed, v = solve(lines, np.array([0.0, 0.0]))
    assert failed < 3
    v = relax(lines, failed, v)
    assert np.isfinite(v).all() and np.linalg.norm(v) < LIMIT + ATOL
    assert violation(lines, v) == pytest.approx(least_violation(lines, LIMIT), abs=2e-2)
