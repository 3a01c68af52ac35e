"""The repulsive field: Khatib's potential by finite differences, by hand, and its limits."""

import math

import numpy as np
import pytest

from sim_core.config import WorldConfig
from sim_core.methods.apf import field_of, field_params, limited, repulsion

PARAMS = field_params(WorldConfig(apf_range_m=0.8, apf_gain_m4_s=0.05, apf_limit_m_s=2.0))


def potential(x, y, robots, p):
    """U at (x, y), Khatib 1986: k/2 (1/d - 1/d0)^2 within d0, summed over robots."""
    total = 0.0
    for robot_x, robot_y in robots:
        distance = math.hypot(x - robot_x, y - robot_y)
        if distance < p.range_m:
            total += 0.5 * p.gain * (1 / distance - 1 / p.range_m) ** 2
    return total


def field(pos, robot=0, begin=0, end=None, p=PARAMS):
    """u_apf of one robot of positions `[num_robots, 2]`."""
    pos_x, pos_y = np.ascontiguousarray(np.asarray(pos, float).T)
    return field_of(robot, begin, len(pos) if end is None else end, pos_x, pos_y, p)


def test_by_hand():
    p = field_params(WorldConfig(apf_range_m=0.5, apf_gain_m4_s=0.01, apf_limit_m_s=9.0))
    assert repulsion(0.25, 0.0, p) == pytest.approx((-0.01 * (4 - 2) / 0.0625, 0))
    assert repulsion(0.0, -0.4, p) == pytest.approx((0, 0.01 * 0.5 / 0.16))
    assert repulsion(0.5, 0.0, p) == (0, 0)


def test_the_field_is_minus_the_potentials_gradient():
    rng, compared = np.random.default_rng(0), 0
    for _ in range(300):
        pos, step = rng.uniform(-1, 1, (6, 2)), 1e-6
        x, y = field(pos)
        if math.hypot(x, y) > 1.99 or np.linalg.norm(pos[1:] - pos[0], axis=1).min() < 0.3:
            continue  # a limit holds there
        gradient = [
            (potential(*(pos[0] + step * axis), pos[1:], PARAMS) - potential(*(pos[0] - step * axis), pos[1:], PARAMS))
            / (2 * step)
            for axis in np.eye(2)
        ]
        np.testing.assert_allclose((x, y), -np.array(gradient), atol=1e-6)
        compared += math.hypot(x, y) > 0.01
    assert compared > 50


@pytest.mark.parametrize("distance", [0.0, 1e-300, 1e-30, 1e-7, 1e-6, 1e-3, 0.1])
def test_a_robot_however_near_pushes_no_harder_than_the_limit(distance):
    x, y = repulsion(distance, -distance, PARAMS)
    assert math.hypot(x, y) <= 2.0 + 1e-12
    if distance >= 1e-6:
        assert (x, y) == pytest.approx((-math.sqrt(2), math.sqrt(2)))


def test_many_robots_push_no_harder_than_the_limit():
    rng = np.random.default_rng(1)
    for _ in range(100):
        assert math.hypot(*field(rng.normal(0, 0.2, (30, 2)))) <= 2.0 + 1e-12
    assert field([(0, 0), (0.2, 0), (0.2, 0.01), (0.2, -0.01)]) == pytest.approx((-2, 0))


def test_robots_on_both_sides_cancel_and_the_robot_itself_does_not_count():
    assert field([(0, 0), (0.3, 0), (-0.3, 0)]) == pytest.approx((0, 0), abs=1e-12)
    assert field([(5, 5)]) == (0, 0)


def test_only_robots_asked_for_count():
    pos = [(0, 0), (0.3, 0), (0, 0.3), (0.3, 0.3)]
    assert field(pos, begin=0, end=2) == pytest.approx(repulsion(0.3, 0.0, PARAMS))
    assert field(pos, begin=2, end=3) == pytest.approx(repulsion(0.0, 0.3, PARAMS))
    assert field(pos, robot=3, begin=3, end=4) == (0, 0)


def test_no_gain_no_field():
    p = field_params(WorldConfig(apf_gain_m4_s=0.0))
    assert math.hypot(*field([(0, 0), (0.01, 0), (0, 0.3)], p=p)) == 0


def test_limited_keeps_the_direction():
    assert limited(3.0, 4.0, 5.0) == (3, 4)
    assert limited(3.0, 4.0, 1.0) == pytest.approx((0.6, 0.8))
    assert limited(0.0, 0.0, 1.0) == (0, 0)
