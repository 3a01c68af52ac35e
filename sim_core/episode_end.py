"""Kernels that decide how an episode ends; `sim_core.outcomes` defines the outcomes."""

from __future__ import annotations

import numpy as np

from sim_core.jit import inlined, kernel
from sim_core.lanes import LANES, any_lane, count_lanes, lane_numbers, load_some
from sim_core.outcomes import Outcome

_GOAL, _LOST, _CAPTURED = int(Outcome.GOAL), int(Outcome.LOST), int(Outcome.CAPTURED)
_COLLISION, _RUNNING = int(Outcome.COLLISION), int(Outcome.RUNNING)


@inlined
def _near(first, robot, pos_x, pos_y, distance_sq):
    """The numbers of the robots from `first` on, a lane each, and which of them are nearer than that to `robot`."""
    number, count = lane_numbers() + first, pos_x.shape[0] - first
    dx = load_some(pos_x, first, count) - pos_x[robot]
    dy = load_some(pos_y, first, count) - pos_y[robot]
    return number, (dx * dx + dy * dy < distance_sq) & (number < pos_x.shape[0])


@kernel
def collides(robot, pos_x, pos_y, distance_sq):
    """Whether any other robot's centre is nearer than the square root of `distance_sq` (m^2)."""
    num_robots = pos_x.shape[0]
    for first in range(0, num_robots, LANES):
        number, near = _near(first, robot, pos_x, pos_y, distance_sq)
        if any_lane(near & (number != robot)):
            return True
    return False


@kernel
def sensed(robot, begin, end, pos_x, pos_y, range_sq):
    """(own, others): robots of the own group begin..end-1 and of other groups within the sensing range."""
    own, everybody = -1, -1  # the robot itself is not counted
    for first in range(0, pos_x.shape[0], LANES):
        number, near = _near(first, robot, pos_x, pos_y, range_sq)
        own += count_lanes(near & (number >= begin) & (number < end))
        everybody += count_lanes(near)
    return own, everybody - own


@kernel
def group_goal_distance_m(begin, end, pos_x, pos_y, goal_x, goal_y, of_centroid):
    """Mean distance of the robots begin..end-1 to the point (goal_x, goal_y), or their centroid's (Eq. 3.2), metres.

    Robots at NaN have left the world and do not count.
    """
    count = 0
    if of_centroid:
        sum_x, sum_y = 0.0, 0.0
        for i in range(begin, end):
            if pos_x[i] == pos_x[i]:
                sum_x, sum_y, count = sum_x + (pos_x[i] - goal_x), sum_y + (pos_y[i] - goal_y), count + 1
        return np.sqrt(sum_x * sum_x + sum_y * sum_y) / count
    total = 0.0
    for i in range(begin, end):
        if pos_x[i] == pos_x[i]:
            dx, dy = pos_x[i] - goal_x, pos_y[i] - goal_y
            total, count = total + np.sqrt(dx * dx + dy * dy), count + 1
    return total / count


@kernel
def collision_or_goal(robot, begin, end, pos_x, pos_y, goal_x, goal_y, collision_sq, range_m, of_centroid):
    """COLLISION or GOAL where one holds after a step, else RUNNING; the same for every method.

    The robot's group are the robots begin..end-1, its goal is (goal_x, goal_y); `of_centroid` as `group_distance` says.
    """
    if collides(robot, pos_x, pos_y, collision_sq):
        return _COLLISION
    if group_goal_distance_m(begin, end, pos_x, pos_y, goal_x, goal_y, of_centroid) < range_m:
        return _GOAL
    return _RUNNING


@kernel
def _all_on_one_side(robot, edge, pos_x, pos_y, range_sq):
    """Whether no sensed robot is to the right of the line from `robot` through the robot `edge`."""
    edge_x, edge_y = pos_x[edge] - pos_x[robot], pos_y[edge] - pos_y[robot]
    for other in range(pos_x.shape[0]):
        dx, dy = pos_x[other] - pos_x[robot], pos_y[other] - pos_y[robot]
        if dx * dx + dy * dy < range_sq and edge_x * dy - edge_y * dx < 0.0:
            return False
    return True


@kernel
def surrounded(robot, pos_x, pos_y, range_sq):
    """Whether a robot stands inside the convex hull of those that it senses: none is a tangent point from it."""
    nobody = True
    for other in range(pos_x.shape[0]):
        dx, dy = pos_x[other] - pos_x[robot], pos_y[other] - pos_y[robot]
        if other != robot and dx * dx + dy * dy < range_sq:
            nobody = False
            if _all_on_one_side(robot, other, pos_x, pos_y, range_sq):
                return False
    return not nobody


@kernel
def lost_or_captured(robot, begin, end, pos_x, pos_y, range_sq, must_surround):
    """How a robot fails that is away from its group; `must_surround` as `captured_is` has it."""
    own, others = sensed(robot, begin, end, pos_x, pos_y, range_sq)
    if own > 0 or others == 0 or (must_surround and not surrounded(robot, pos_x, pos_y, range_sq)):
        return _LOST
    return _CAPTURED


@kernel
def end_of_step(robot, begin, end, pos_x, pos_y, goal_x, goal_y, collision_sq, range_m, of_centroid, must_surround):
    """Outcome of one world after a step of a robot that is lost once it senses no own robot."""
    ended = collision_or_goal(robot, begin, end, pos_x, pos_y, goal_x, goal_y, collision_sq, range_m, of_centroid)
    if ended != _RUNNING:
        return ended
    range_sq = range_m * range_m
    own, _ = sensed(robot, begin, end, pos_x, pos_y, range_sq)
    return lost_or_captured(robot, begin, end, pos_x, pos_y, range_sq, must_surround) if own == 0 else _RUNNING
