"""u_apf: the repulsive part of an artificial potential field (Khatib 1986) around the robots that r_l senses.

A robot at distance d, nearer than the range d_0, adds U(d) = k/2 (1/d - 1/d_0)^2 to the potential, and minus the
gradient of U to the velocity: k (1/d - 1/d_0) / d^2 away from it. Distances are those of centres, like R1. One
robot's part is no longer than the limit, and so is the sum; a robot at the very same place has no direction
and adds nothing. The text gives neither gain nor limit; Algorithm 4.2 takes R1 as the range.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim_core.config import WorldConfig
from sim_core.jit import kernel

NEAREST_M = 1e-6
"""A robot nearer than this has no direction."""


class FieldParams(NamedTuple):
    """Constants of the repulsive potential."""

    range_m: float
    gain: float
    limit_m_s: float


def field_params(config: WorldConfig) -> FieldParams:
    """The constants of `config`."""
    return FieldParams(float(config.apf_range_m), float(config.apf_gain_m4_s), float(config.apf_limit_m_s))


@kernel
def limited(x, y, limit):
    """(x, y), shortened to the length `limit` where it is longer."""
    length = math.sqrt(x * x + y * y)
    if length <= limit:
        return x, y
    return x * (limit / length), y * (limit / length)


@kernel
def repulsion(dx, dy, p):
    """Velocity (m/s) away from a robot that is (dx, dy) metres off. `p`: FieldParams."""
    distance = math.sqrt(dx * dx + dy * dy)
    if not NEAREST_M <= distance < p.range_m:  # nor where it is NaN: not sensed
        return 0.0, 0.0
    speed = p.gain * (1.0 / distance - 1.0 / p.range_m) / (distance * distance)
    speed = min(speed, p.limit_m_s)
    return -speed * dx / distance, -speed * dy / distance


@kernel
def field_of(robot, begin, end, pos_x, pos_y, p):
    """u_apf (m/s) of `robot` from the robots begin..end-1 but itself. `p`: FieldParams."""
    total_x, total_y = 0.0, 0.0
    for other in range(begin, end):
        if other != robot:
            x, y = repulsion(pos_x[other] - pos_x[robot], pos_y[other] - pos_y[robot], p)
            total_x, total_y = total_x + x, total_y + y
    return limited(total_x, total_y, p.limit_m_s)
