"""ORCA for discs: the half-planes and linear programs of van den Berg et al. (2011), for eight robots at a time.

J. van den Berg, S. J. Guy, M. Lin, D. Manocha, "Reciprocal n-body collision avoidance", ISRR 2009 (Springer 2011).
Sections and figures below are the paper's. Cases are labelled as in RVO2, its reference implementation.

A half-plane ORCA^tau_A|B is a line, given by a point and a unit direction. Its permitted velocities lie to the left of
the line. The half-planes of eight robots are four vectors (point x, point y, direction x, direction y), stored in
scratch `[max_neighbours, 4, 8]`. A robot with fewer half-planes than the others has zeros in the rest: a line without
a direction forbids nothing.

Kernels compute in the dtype of their arguments (float32 in the worlds) and allocate nothing. They take every constant
from `ORCAParams`, so that no float64 literal widens the arithmetic. The order of operations is RVO2's, reciprocals
included, so that float32 results equal RVO2's bit for bit. There are two exceptions, where RVO2 fails: coincident
robots (see `half_plane`) and the speed limit (see `orca_velocity`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sim_core.jit import inlined
from sim_core.lanes import any_lane, gather_4, load, maximum, minimum, select, splat, sqrt, store

EPSILON = 1e-5
"""Lines are parallel if the cross product of their directions is at most this (RVO2's value)."""


class ORCAParams(NamedTuple):
    """ORCA's constants in the worlds' dtype."""

    half: Any
    one: Any
    zero: Any
    epsilon: Any
    combined_radius_m: Any
    inverse_horizon_1_s: Any
    inverse_time_step_1_s: Any
    max_speed_m_s: Any
    responsibility: Any


def orca_params(
    radius_m: float,
    horizon_s: float,
    time_step_s: float,
    max_speed_m_s: float,
    dtype: Any,
    *,
    responsibility: float = 0.5,
) -> ORCAParams:
    """The constants for robots of one radius, each a scalar of `dtype`.

    `responsibility` is the share of the avoidance that a robot takes: half of it where both robots of a pair avoid
    each other, all of it where the other one does not.
    """
    real = np.dtype(dtype).type
    return ORCAParams(
        half=real(0.5),
        one=real(1),
        zero=real(0),
        epsilon=real(EPSILON),
        combined_radius_m=real(radius_m) + real(radius_m),
        inverse_horizon_1_s=real(1) / real(horizon_s),
        inverse_time_step_1_s=real(1) / real(time_step_s),
        max_speed_m_s=real(max_speed_m_s),
        responsibility=real(responsibility),
    )


@inlined
def half_plane(rel_x, rel_y, rel_vx, rel_vy, vx, vy, tie_sign, p):
    """The half-planes ORCA^tau_A|B of eight robots A, each induced by one neighbour B (Section 4.2, Fig. 3).

    The velocity obstacle VO^tau_A|B, truncated at the time horizon tau, holds the relative velocities that lead to a
    collision before tau (Section 4.1, Fig. 1 (b)). It is a cone with its apex at the origin. Its two legs are tangent
    to the disc of the combined radius around B's relative position. The cut-off circle bounds the cone towards the
    apex; its radius is the combined radius / tau, its centre is the relative position / tau.

    The vector u leads from the relative velocity to the nearest point of the obstacle's boundary. Each robot of a pair
    takes half of it (`p.responsibility`): the line passes through the robot's velocity + u / 2, parallel to the
    boundary's tangent at that point. The optimisation velocities are the current velocities (Section 5.2). The cases
    are:

    * No collision: project on the cut-off circle, on the left leg, or on the right leg.
    * Collision, i.e. the discs overlap: project on the cut-off circle of the time step, so that they part in one step.

    Where the relative velocity is the centre of the cut-off circle, as for two robots of equal position and velocity,
    u has no direction. RVO2 divides 0 by 0 there. Here u points to +x for one robot and to -x for the other.

    Args:
      rel_x, rel_y: vectors, the neighbour's position relative to the robot, metres.
      rel_vx, rel_vy: vectors, the robot's velocity relative to the neighbour, m/s.
      vx, vy: vectors, the robot's velocity, m/s.
      tie_sign: vector, +1 for one robot of a pair and -1 for the other: the sign of u_x where u has no direction.
      p: ORCAParams.

    Returns:
      (point x, point y, direction x, direction y), vectors; points in m/s.
    """
    dist_sq = rel_x * rel_x + rel_y * rel_y
    radius = p.combined_radius_m
    radius_sq = radius * radius
    no_collision = dist_sq > radius_sq
    inverse_time = select(no_collision, splat(p.inverse_horizon_1_s), p.inverse_time_step_1_s)
    # w: vector from the centre of the cut-off circle to the relative velocity.
    w_x = rel_vx - inverse_time * rel_x
    w_y = rel_vy - inverse_time * rel_y
    w_sq = w_x * w_x + w_y * w_y
    dot = w_x * rel_x + w_y * rel_y
    # The circle's arc between the legs faces the apex. In a collision there are no legs.
    on_circle = ~no_collision | ((dot < p.zero) & (dot * dot > radius_sq * w_sq))

    # Project on the cut-off circle.
    w_length = sqrt(w_sq)
    has_direction = w_length > p.epsilon * p.epsilon * p.epsilon  # shorter vectors underflow when they are squared
    scale = p.one / w_length
    unit_x, unit_y = select(has_direction, w_x * scale, tie_sign), select(has_direction, w_y * scale, p.zero)
    u_length = radius * inverse_time - w_length

    # Project on a leg: the left one if w lies to the left of the cone's axis, else the right one. In a collision the
    # root is NaN, and the case is not selected.
    leg = sqrt(dist_sq - radius_sq)
    scale = p.one / dist_sq
    on_left_leg = rel_x * w_y - rel_y * w_x > p.zero
    leg_x = select(on_left_leg, (rel_x * leg - rel_y * radius) * scale, -(rel_x * leg + rel_y * radius) * scale)
    leg_y = select(on_left_leg, (rel_x * radius + rel_y * leg) * scale, -(rel_y * leg - rel_x * radius) * scale)
    along_leg = rel_vx * leg_x + rel_vy * leg_y

    u_x = select(on_circle, u_length * unit_x, along_leg * leg_x - rel_vx)
    u_y = select(on_circle, u_length * unit_y, along_leg * leg_y - rel_vy)
    dir_x, dir_y = select(on_circle, unit_y, leg_x), select(on_circle, -unit_x, leg_y)
    return vx + p.responsibility * u_x, vy + p.responsibility * u_y, dir_x, dir_y


@inlined
def load_line(lines, line_no):
    """Line `line_no` of each of eight robots from scratch `[max_neighbours, 4, 8]`: four vectors."""
    start = 4 * line_no
    return load(lines, start), load(lines, start + 1), load(lines, start + 2), load(lines, start + 3)


@inlined
def store_line(lines, line_no, point_x, point_y, dir_x, dir_y):
    """Writes line `line_no` of each of eight robots to scratch `[max_neighbours, 4, 8]`."""
    store(lines, 4 * line_no, point_x)
    store(lines, 4 * line_no + 1, point_y)
    store(lines, 4 * line_no + 2, dir_x)
    store(lines, 4 * line_no + 3, dir_y)


@inlined
def violation(lines, line_no, x, y):
    """How far the velocities (x, y) lie outside the half-planes `line_no`, m/s; negative inside."""
    point_x, point_y, dir_x, dir_y = load_line(lines, line_no)
    return dir_x * (point_y - y) - dir_y * (point_x - x)


@inlined
def linear_program_1(lines, line_no, opt_x, opt_y, direction_opt, p):
    """Optimises on the lines `line_no`, subject to the half-planes before them and the disc of the maximum speed.

    Args:
      lines: `[max_neighbours, 4, 8]`.
      line_no: index of the line to optimise on.
      opt_x, opt_y: vectors, the optimisation velocities, m/s; unit directions if `direction_opt`.
      direction_opt: whether to go farthest along `opt` instead of closest to it.
      p: ORCAParams.

    Returns:
      (feasible, x, y): mask, and the optimal velocities, m/s. A velocity has no meaning where it is not feasible.
    """
    px, py, dx, dy = load_line(lines, line_no)
    dot = px * dx + py * dy
    discriminant = dot * dot + p.max_speed_m_s * p.max_speed_m_s - (px * px + py * py)
    feasible = ~(discriminant < p.zero)  # else the disc of the maximum speed lies outside the half-plane
    half_chord = sqrt(discriminant)
    t_left = -dot - half_chord
    t_right = -dot + half_chord
    for i in range(line_no):
        qx, qy, ex, ey = load_line(lines, i)
        denominator = dx * ey - dy * ex
        numerator = ex * (py - qy) - ey * (px - qx)
        # Lines i and line_no are (almost) parallel: line_no lies either wholly outside half-plane i, or inside.
        parallel = abs(denominator) <= p.epsilon
        feasible = feasible & ~(parallel & (numerator < p.zero))
        # Line i bounds line line_no on the right, or else on the left.
        t = numerator / denominator
        bounds_right = denominator >= p.zero
        t_right = minimum(select(parallel | ~bounds_right, t_right, t), t_right)
        t_left = maximum(select(parallel | bounds_right, t_left, t), t_left)
    feasible = feasible & ~(t_left > t_right)
    if direction_opt:  # optimise the direction: take an end of the interval
        t = select(opt_x * dx + opt_y * dy > p.zero, t_right, t_left)
    else:  # optimise the closest point
        t = dx * (opt_x - px) + dy * (opt_y - py)
        t = minimum(maximum(t, t_left), t_right)
    return feasible, px + t * dx, py + t * dy


@inlined
def linear_program_2(lines, num_lines, opt_x, opt_y, active, direction_opt, p):
    """The velocities closest to `opt` in the intersection of the half-planes and the speed disc (Section 5.1).

    The program is incremental: half-planes are added one at a time, and only one that the present optimum violates
    moves the optimum, to a point of its line.

    Args:
      lines: `[max_neighbours, 4, 8]`.
      num_lines: number of half-planes, the most that any of the eight robots has.
      opt_x, opt_y: vectors, the optimisation velocities, m/s; unit directions if `direction_opt`.
      active: mask of the robots to solve for; results of the others have no meaning.
      direction_opt: whether to go farthest along `opt` instead of closest to it.
      p: ORCAParams.

    Returns:
      (failed_line, x, y): int32 vector, `num_lines` where the program is feasible, else the first half-plane that
      could not be satisfied; and the optimal velocities under the half-planes before that one, m/s.
    """
    if direction_opt:  # optimise the direction: `opt` has unit length
        x, y = opt_x * p.max_speed_m_s, opt_y * p.max_speed_m_s
    else:  # optimise the closest point, which is `opt` itself or, if that lies outside the disc, on its circle
        opt_sq = opt_x * opt_x + opt_y * opt_y
        scale = p.one / sqrt(opt_sq)
        outside_disc = opt_sq > p.max_speed_m_s * p.max_speed_m_s
        x = select(outside_disc, opt_x * scale * p.max_speed_m_s, opt_x)
        y = select(outside_disc, opt_y * scale * p.max_speed_m_s, opt_y)
    failed_line = splat(num_lines)
    for i in range(num_lines):
        violated = active & (violation(lines, i, x, y) > p.zero)
        if any_lane(violated):  # constraint i is not satisfied: compute the new optimum
            feasible, new_x, new_y = linear_program_1(lines, i, opt_x, opt_y, direction_opt, p)
            moves, fails = violated & feasible, violated & ~feasible
            x, y = select(moves, new_x, x), select(moves, new_y, y)
            failed_line = select(fails, i, failed_line)
            active = active & ~fails
    return failed_line, x, y


@inlined
def _project_lines(lines, line_no, projected, p):
    """Writes the constraints of the third program: violate no half-plane j < `line_no` more than `line_no`.

    Each is a half-plane, too. If half-plane j has the direction of `line_no`, it imposes no constraint and row j is
    filled with zeros.

    Args:
      lines: `[max_neighbours, 4, 8]`.
      line_no: index of the half-plane.
      projected: scratch `[max_neighbours, 4, 8]`, written up to row `line_no` - 1.
      p: ORCAParams.
    """
    px, py, dx, dy = load_line(lines, line_no)
    for j in range(line_no):
        qx, qy, ex, ey = load_line(lines, j)
        determinant = dx * ey - dy * ex
        parallel = abs(determinant) <= p.epsilon
        same_direction = parallel & (dx * ex + dy * ey > p.zero)
        t = (ex * (py - qy) - ey * (px - qx)) / determinant
        # Parallel lines of opposite directions: halfway between them. Other lines: their intersection.
        point_x = select(parallel, p.half * (px + qx), px + t * dx)
        point_y = select(parallel, p.half * (py + qy), py + t * dy)
        new_dx, new_dy = ex - dx, ey - dy
        scale = p.one / sqrt(new_dx * new_dx + new_dy * new_dy)
        store_line(
            projected,
            j,
            select(same_direction, p.zero, point_x),
            select(same_direction, p.zero, point_y),
            select(same_direction, p.zero, new_dx * scale),
            select(same_direction, p.zero, new_dy * scale),
        )


@inlined
def linear_program_3(lines, num_lines, failed_line, x, y, projected, p):
    """The velocities whose largest violation is smallest, for robots that no velocity satisfies (Section 5.3).

    Args:
      lines: `[max_neighbours, 4, 8]`.
      num_lines: number of half-planes.
      failed_line, x, y: the result of the second program. Robots with `failed_line == num_lines` keep (x, y).
      projected: scratch `[max_neighbours, 4, 8]`.
      p: ORCAParams.

    Returns:
      (x, y), m/s.
    """
    distance = splat(p.zero)
    for i in range(num_lines):
        _, _, dir_x, dir_y = load_line(lines, i)
        present = (dir_x != p.zero) | (dir_y != p.zero)  # needed, as rounding can make `distance` negative
        violated = present & (failed_line <= i) & (violation(lines, i, x, y) > distance)
        if any_lane(violated):  # constraint i is violated more than those before it: minimise its violation
            _project_lines(lines, i, projected, p)
            failed, new_x, new_y = linear_program_2(projected, i, -dir_y, dir_x, violated, True, p)
            # The old optimum is feasible here, so the program can only fail by rounding; then the old one is kept.
            solved = violated & (failed == i)
            x, y = select(solved, new_x, x), select(solved, new_y, y)
            distance = select(violated, violation(lines, i, x, y), distance)
    return x, y


@inlined
def build_half_planes(robot, pos_vel, neighbours, start, count, lines, p):
    """Writes the half-planes of eight robots, one per neighbour.

    Args:
      robot: int32 vector, the robots' rows in `pos_vel`.
      pos_vel: `[slots, 4]`, positions (metres) and velocities (m/s) in the old state.
      neighbours: int32; vectors `start` to `start + count - 1` hold the neighbours' rows in `pos_vel`, nearest first,
        -1 for none.
      start, count: see `neighbours`.
      lines: `[max_neighbours, 4, 8]`, written up to row `count - 1`.
      p: ORCAParams.
    """
    x, y, vx, vy = gather_4(pos_vel, robot)
    for k in range(count):
        other = load(neighbours, start + k)
        present = other >= 0
        other = select(present, other, robot)
        other_x, other_y, other_vx, other_vy = gather_4(pos_vel, other)
        tie_sign = select(robot < other, splat(p.one), -p.one)
        point_x, point_y, dir_x, dir_y = half_plane(
            other_x - x, other_y - y, vx - other_vx, vy - other_vy, vx, vy, tie_sign, p
        )
        store_line(
            lines,
            k,
            select(present, point_x, p.zero),
            select(present, point_y, p.zero),
            select(present, dir_x, p.zero),
            select(present, dir_y, p.zero),
        )


@inlined
def orca_velocity(lines, num_lines, pref_x, pref_y, projected, p):
    """ORCA's new velocities of eight robots (Section 5).

    Feasible: the second program gives the permitted velocity closest to the preferred one (Section 5.1). Infeasible:
    the third program gives the velocity that violates the half-planes least (densely packed conditions, Section 5.3).

    Args:
      lines: `[max_neighbours, 4, 8]`, the half-planes, nearest neighbour first.
      num_lines: number of half-planes, the most that any of the eight robots has.
      pref_x, pref_y: vectors, the robots' preferred velocities, m/s.
      projected: scratch `[max_neighbours, 4, 8]`.
      p: ORCAParams.

    Returns:
      (x, y): the new velocities, m/s, no faster than `p.max_speed_m_s` up to rounding. The third program loses digits
      where half-planes are almost parallel, and can leave the speed disc. Its result is then scaled to the maximum
      speed; RVO2 keeps it.
    """
    everyone = splat(True)
    failed_line, x, y = linear_program_2(lines, num_lines, pref_x, pref_y, everyone, False, p)
    infeasible = failed_line < num_lines
    if any_lane(infeasible):
        x, y = linear_program_3(lines, num_lines, failed_line, x, y, projected, p)
        speed_sq, limit_sq = x * x + y * y, p.max_speed_m_s * p.max_speed_m_s
        too_fast = infeasible & (speed_sq > limit_sq + limit_sq * p.epsilon)
        scale = p.max_speed_m_s / sqrt(speed_sq)
        x, y = select(too_fast, x * scale, x), select(too_fast, y * scale, y)
    return x, y
