"""Group ellipses: Eq. 4.1 to 4.7 by hand, numpy's covariance and eigenvalues, the share of a Gaussian inside."""

import math

import numpy as np
import pytest
from scipy import stats

from sim_core.config import WorldConfig
from sim_core.methods.ellipse import (
    NOBODY,
    ellipse_params,
    group_centre,
    group_covariance,
    group_ellipse,
    in_ellipse,
    left_out_of,
    principal_axes,
)

REAL = np.float32


def ellipse(pos, group=0, left_out=NOBODY, **settings):
    """(a, b, x_c, y_c, theta) of positions `[num_robots, 2]`."""
    config = WorldConfig(**({"method": "out", "robots": len(pos), "groups": 1, "arena_radius_m": 60.0} | settings))
    begin = group * config.robots
    pos_x, pos_y = np.ascontiguousarray(np.asarray(pos, REAL).T)
    return group_ellipse(begin, begin + config.robots, pos_x, pos_y, left_out, ellipse_params(config))


def test_eq_4_5_and_4_6_by_hand():
    pos_x, pos_y = np.array([9, 9, 1, 2, 6], REAL), np.array([9, 9, 0, 4, 2], REAL)
    assert group_centre(0, 2, pos_x, pos_y, NOBODY) == (9, 9, 2)
    assert group_centre(0, 5, pos_x, pos_y, 4) == (5.25, 5.5, 4)
    assert group_centre(0, 5, pos_x, pos_y, NOBODY) == (pytest.approx(5.4), pytest.approx(4.8), 5)


def test_eq_4_3_and_4_4_by_hand():
    """Variances 4 in x and 1 in y: eigenvalues 4 and 1, so b = sqrt(4 C) and a = sqrt(C), halved as printed."""
    pos = [(2, 0), (-2, 0), (0, 1), (0, -1), (0, 0)]  # sums of squares 8 and 2, over n - 1 = 4
    a, b, x_c, y_c, theta = ellipse(pos, ellipse_chi_square=8.0)
    assert (a, b, x_c, y_c, theta) == pytest.approx((2.0, 4.0, 0, 0, 0))
    assert ellipse(pos, ellipse_chi_square=8.0, ellipse_axes="printed")[:2] == pytest.approx((1.0, 2.0))
    assert ellipse(pos)[:2] == pytest.approx((math.sqrt(5.991 * 0.5), math.sqrt(5.991 * 2)))


def test_eq_4_7_by_hand():
    """theta is the angle from the x-axis to the largest spread."""
    for turn in (0, 30, 60, 89, -30, -89):
        cos, sin = math.cos(math.radians(turn)), math.sin(math.radians(turn))
        pos = [(t * cos - s * sin, t * sin + s * cos) for t, s in ((2, 0), (-2, 0), (0, 1), (0, -1), (0, 0))]
        a, b, _, _, theta = ellipse(pos, ellipse_chi_square=8.0, ellipse_covariance="full")
        assert (a, b, math.degrees(theta)) == pytest.approx((2.0, 4.0, turn), abs=1e-4)
    upright = [(0, 2), (0, -2), (1, 0), (-1, 0), (0, 0)]
    for covariance in ("full", "diagonal"):
        assert ellipse(upright, ellipse_covariance=covariance)[4] == math.pi / 2


def test_sigma_xy_is_zero_unless_the_covariance_is_full():
    slanted = [(1, 1), (-1, -1), (0.5, 0.6), (-0.5, -0.6)]
    a, b, _, _, theta = ellipse(slanted)
    assert theta == math.pi / 2 and a > 0.9 * b  # nearly round, since the slant is in sigma_xy alone
    a, b, _, _, theta = ellipse(slanted, ellipse_covariance="full")
    assert math.degrees(theta) == pytest.approx(46, abs=1) and a < 0.1 * b


def test_eq_4_1_and_4_2_by_hand():
    for x, y, inside in (
        (4, 0, True),
        (4.01, 0, False),
        (0, 2, True),
        (0, 2.01, False),
        (2.8, 1.4, True),
        (3, 1.5, False),
    ):
        assert in_ellipse(x + 7.0, y - 3.0, 2.0, 4.0, 7.0, -3.0, 0.0) == inside
        assert in_ellipse(-y, x, 2.0, 4.0, 0.0, 0.0, math.pi / 2 - 1e-12) == inside or abs(x) == 4


def test_eq_4_2_as_printed_is_ours_with_the_angle_from_the_y_axis():
    rng = np.random.default_rng(0)
    for _ in range(500):
        theta, (a, b), (x, y) = rng.uniform(-1.5, 1.5), np.sort(rng.uniform(0.5, 3, 2)), rng.uniform(-3, 3, 2)
        printed = math.pi / 2 - theta
        u, v = x * math.cos(printed) - y * math.sin(printed), x * math.sin(printed) + y * math.cos(printed)
        assert in_ellipse(x, y, a, b, 0.0, 0.0, theta) == ((u / a) ** 2 + (v / b) ** 2 <= 1)


def test_covariance_and_axes_match_numpy():
    rng = np.random.default_rng(1)
    for _ in range(200):
        robots, left = int(rng.integers(3, 30)), int(rng.integers(-1, 3))
        pos = (rng.normal(0, 1, (robots, 2)) @ rng.normal(0, 1, (2, 2)) + rng.uniform(-9, 9, 2)).astype(REAL)
        kept = np.delete(pos, left, axis=0) if left >= 0 else pos
        exact = np.cov(kept.astype(np.float64).T)
        x, y, xx, xy, yy = group_covariance(0, robots, *np.ascontiguousarray(pos.T), left)
        np.testing.assert_allclose((x, y), kept.mean(axis=0, dtype=np.float64), rtol=1e-6)
        np.testing.assert_allclose((xx, xy, xy, yy), exact.ravel(), rtol=1e-9, atol=1e-12)
        values, vectors = np.linalg.eigh(exact)
        largest, smallest, theta = principal_axes(xx, xy, yy)
        np.testing.assert_allclose((smallest, largest), values, rtol=1e-6, atol=1e-9 * values[1])
        cross = math.cos(theta) * vectors[1, 1] - math.sin(theta) * vectors[0, 1]
        assert abs(cross) < 1e-5 * values[1] / (values[1] - values[0])
        assert -math.pi / 2 < theta <= math.pi / 2


def test_the_region_holds_what_chi_square_says():
    """95 % of a Gaussian, and by the printed axes a share of 1 - exp(-C / 8)."""
    rng = np.random.default_rng(2)
    assert stats.chi2(2).cdf(5.991) == pytest.approx(0.95, abs=1e-4)
    for axes, share in (("confidence", 0.95), ("printed", 1 - math.exp(-5.991 / 8))):
        pos = (rng.normal(0, 1, (20_000, 2)) @ [[1.0, 0.6], [0.0, 0.3]]).astype(REAL)
        found = ellipse(pos, ellipse_covariance="full", ellipse_axes=axes, arena_radius_m=1e5)
        inside = [in_ellipse(x, y, *found) for x, y in pos.astype(float)]
        assert np.mean(inside) == pytest.approx(share, abs=0.01)


SLIM = 0.01
DEGENERATE = {  # positions, and the expected a and b in the full covariance
    "all in one place": ([(3, 4)] * 4, SLIM, SLIM),
    "in a row": ([(0, 0), (1, 0), (2, 0)], SLIM, math.sqrt(5.991)),
    "in a column": ([(0, 0), (0, 1), (0, 2)], SLIM, math.sqrt(5.991)),
    "on a diagonal": ([(0, 0), (1, 1), (2, 2)], SLIM, math.sqrt(2 * 5.991)),
    "two robots": ([(0, 0), (0, 2)], SLIM, math.sqrt(2 * 5.991)),
    "round": ([(1, 0), (-1, 0), (0, 1), (0, -1)], math.sqrt(2 / 3 * 5.991), math.sqrt(2 / 3 * 5.991)),
    "far away": ([(1e6, 1e6)] * 3, SLIM, SLIM),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_groups_have_an_ellipse(name):
    pos, a, b = DEGENERATE[name]
    found = ellipse(pos, ellipse_covariance="full", ellipse_counts_learner=True)
    assert np.isfinite(found).all()
    assert found[:2] == pytest.approx((a, b), rel=1e-6)
    assert in_ellipse(found[2], found[3], *found)
    assert not in_ellipse(found[2] + 50, found[3] + 30, *found)


def test_one_robot_alone_has_the_smallest_ellipse():
    assert ellipse([(0, 0), (3, 4)], left_out=0, ellipse_counts_learner=True) == (SLIM, SLIM, 3, 4, 0)


def own(pos, learner, robots, **settings):
    settings = {"method": "out", "robots": robots, "groups": len(pos) // robots, "arena_radius_m": 60.0} | settings
    params = ellipse_params(WorldConfig(**settings))
    begin = learner // robots * robots
    columns = np.ascontiguousarray(np.asarray(pos, REAL).T)
    found = group_ellipse(begin, begin + robots, *columns, left_out_of(learner, params), params)
    return in_ellipse(*columns[:, learner], *found)


def test_the_own_group_is_the_learning_robots():
    pos = [(10, 1), (10, -1), (11, 0), (0, 1), (0, -1), (1, 0)]
    assert own(pos, 3, 3) and own(pos, 0, 3)
    pos[3] = (10, 0)  # in the other group's midst
    assert not own(pos, 3, 3)


def test_five_robots_cannot_lose_one_that_counts():
    """The largest distance of one of n points is (n - 1) / sqrt(n) deviations: below sqrt(5.991) for n = 5."""
    pos = [(0, 0), (1, 0), (0, 1), (1, 1), (500, 0)]
    assert own(pos, 4, 5, ellipse_counts_learner=True)
    assert not own(pos, 4, 5)
    assert not own(pos, 4, 5, ellipse_counts_learner=True, ellipse_axes="printed")
    many = [*[(x % 3, x // 3) for x in range(9)], (500, 0)]
    assert not own(many, 9, 10, ellipse_counts_learner=True)


def test_turning_and_shifting_a_group_turns_and_shifts_its_ellipse():
    rng = np.random.default_rng(3)
    for _ in range(100):
        pos, turn, shift = rng.normal(0, 1, (9, 2)) * (2, 1), rng.uniform(-3, 3), rng.uniform(-9, 9, 2)
        cos, sin = math.cos(turn), math.sin(turn)
        matrix = np.array([[cos, -sin], [sin, cos]])
        a, b, x_c, y_c, theta = ellipse(pos, ellipse_covariance="full")
        moved = ellipse(pos @ matrix.T + shift, ellipse_covariance="full")
        np.testing.assert_allclose(moved[:2], (a, b), rtol=1e-5)
        np.testing.assert_allclose(moved[2:4], matrix @ (x_c, y_c) + shift, atol=1e-5)
        assert abs(math.sin(moved[4] - theta - turn)) < 1e-4 * b / (b - a)
