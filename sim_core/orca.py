"""ORCA for discs: half-planes and the linear programs of van den Berg et al. (2011), eight robots at a time.

J. van den Berg, S. J. Guy, M. Lin, D. Manocha, "Reciprocal n-body collision avoidance", ISRR 2011.
A half-plane is a point and a unit direction; permitted velocities lie to its left. The half-planes of eight
robots are four vectors (point x, point y, direction x, direction y), stored in scratch `[max_neighbours, 4, 8]`.
A robot with fewer of them has zeros in the rest: a direction of zero length forbids nothing.

Kernels compute in the dtype of their arguments (float32 in the worlds), allocate nothing, and take every
constant from `ORCAParams` so that no float64 literal widens the arithmetic. The order of operations is that of
the reference implementation (RVO2), reciprocals included, so that float32 results are equal to its own;
exceptions are robots that coincide and the speed limit (see `orca_velocity`), where it fails.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sim_core.jit import inlined
from sim_core.lanes import any_lane, gather_4, load, maximum, minimum, root, select, splat, store

EPSILON = 1e-5
"""Directions whose cross product is smaller are parallel (the reference implementation's value)."""


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


def orca_params(radius_m: float, horizon_s: float, time_step_s: float, max_speed_m_s: float, dtype: Any) -> ORCAParams:
    """Builds the constants for robots of one radius, each a scalar of `dtype`."""
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
    )


@inlined
def half_plane(rel_x, rel_y, rel_vx, rel_vy, vx, vy, tie_sign, p):
    """The ORCA half-planes that one neighbour each imposes (Section 4 of the paper).

    Args:
      rel_x, rel_y: vectors, the neighbour's position relative to the robot, metres.
      rel_vx, rel_vy: the robot's velocity relative to the neighbour, m/s.
      vx, vy: the robot's velocity, m/s.
      tie_sign: +1 or -1, opposite for the two robots of a pair; side taken when they coincide.
      p: ORCAParams.

    Returns:
      (point x, point y, direction x, direction y), vectors.
    """
    dist_sq = rel_x * rel_x + rel_y * rel_y
    radius = p.combined_radius_m
    radius_sq = radius * radius
    apart = dist_sq > radius_sq
    inverse_time = select(apart, splat(p.inverse_horizon_1_s), p.inverse_time_step_1_s)
    w_x = rel_vx - inverse_time * rel_x
    w_y = rel_vy - inverse_time * rel_y
    w_sq = w_x * w_x + w_y * w_y
    dot = w_x * rel_x + w_y * rel_y
    on_circle = ~apart | ((dot < p.zero) & (dot * dot > radius_sq * w_sq))

    w_length = root(w_sq)
    moving = w_length > p.epsilon * p.epsilon * p.epsilon  # below it, squares underflow: no direction is left
    scale = p.one / w_length
    unit_x, unit_y = select(moving, w_x * scale, tie_sign), select(moving, w_y * scale, p.zero)
    push = radius * inverse_time - w_length

    leg = root(dist_sq - radius_sq)
    scale = p.one / dist_sq
    left = rel_x * w_y - rel_y * w_x > p.zero
    leg_x = select(left, (rel_x * leg - rel_y * radius) * scale, -(rel_x * leg + rel_y * radius) * scale)
    leg_y = select(left, (rel_x * radius + rel_y * leg) * scale, -(rel_y * leg - rel_x * radius) * scale)
    along = rel_vx * leg_x + rel_vy * leg_y

    u_x = select(on_circle, push * unit_x, along * leg_x - rel_vx)
    u_y = select(on_circle, push * unit_y, along * leg_y - rel_vy)
    dir_x, dir_y = select(on_circle, unit_y, leg_x), select(on_circle, -unit_x, leg_y)
    return vx + p.half * u_x, vy + p.half * u_y, dir_x, dir_y


@inlined
def load_line(lines, row):
    """The half-planes in row `row` of scratch `[max_neighbours, 4, 8]`: four vectors."""
    return load(lines, 4 * row), load(lines, 4 * row + 1), load(lines, 4 * row + 2), load(lines, 4 * row + 3)


@inlined
def store_line(lines, row, point_x, point_y, dir_x, dir_y):
    """Writes row `row` of scratch `[max_neighbours, 4, 8]`."""
    store(lines, 4 * row, point_x)
    store(lines, 4 * row + 1, point_y)
    store(lines, 4 * row + 2, dir_x)
    store(lines, 4 * row + 3, dir_y)


@inlined
def violation(lines, row, x, y):
    """How far the velocities lie outside the half-planes of a row, m/s; negative inside."""
    point_x, point_y, dir_x, dir_y = load_line(lines, row)
    return dir_x * (point_y - y) - dir_y * (point_x - x)


@inlined
def linear_program_1(lines, row, opt_x, opt_y, direction_opt, p):
    """Optimises along the edges of half-planes `row`, under the half-planes before them and the speed disc.

    Returns:
      (feasible, x, y): the velocity on the edge nearest to `opt` (or farthest along it if
      `direction_opt`); meaningless where not feasible.
    """
    px, py, dx, dy = load_line(lines, row)
    dot = px * dx + py * dy
    discriminant = dot * dot + p.max_speed_m_s * p.max_speed_m_s - (px * px + py * py)
    feasible = ~(discriminant < p.zero)
    half_chord = root(discriminant)
    t_left = -dot - half_chord
    t_right = -dot + half_chord
    for i in range(row):
        qx, qy, ex, ey = load_line(lines, i)
        denominator = dx * ey - dy * ex
        numerator = ex * (py - qy) - ey * (px - qx)
        parallel = abs(denominator) <= p.epsilon
        feasible = feasible & ~(parallel & (numerator < p.zero))
        t = numerator / denominator
        bounds_right = denominator >= p.zero
        t_right = minimum(select(parallel | ~bounds_right, t_right, t), t_right)
        t_left = maximum(select(parallel | bounds_right, t_left, t), t_left)
    feasible = feasible & ~(t_left > t_right)
    if direction_opt:
        t = select(opt_x * dx + opt_y * dy > p.zero, t_right, t_left)
    else:
        t = dx * (opt_x - px) + dy * (opt_y - py)
        t = minimum(maximum(t, t_left), t_right)
    return feasible, px + t * dx, py + t * dy


@inlined
def linear_program_2(lines, count, opt_x, opt_y, active, direction_opt, p):
    """Velocities nearest to `opt` in the intersection of `count` half-planes and the speed disc.

    Args:
      lines: `[max_neighbours, 4, 8]`.
      count: half-planes to look at, the most that any robot has.
      opt_x, opt_y: vectors, m/s; unit directions to go farthest along if `direction_opt`.
      active: mask of the robots to solve for; the others may cost nothing.
      direction_opt: whether `opt` is a direction.
      p: ORCAParams.

    Returns:
      (failed_row, x, y): `failed_row == count` where feasible, else the first half-plane that could not
      be satisfied, with the optimum under those before it.
    """
    if direction_opt:
        x, y = opt_x * p.max_speed_m_s, opt_y * p.max_speed_m_s
    else:
        opt_sq = opt_x * opt_x + opt_y * opt_y
        scale = p.one / root(opt_sq)
        fast = opt_sq > p.max_speed_m_s * p.max_speed_m_s
        x = select(fast, opt_x * scale * p.max_speed_m_s, opt_x)
        y = select(fast, opt_y * scale * p.max_speed_m_s, opt_y)
    failed_row = splat(count)
    for i in range(count):
        violated = active & (violation(lines, i, x, y) > p.zero)
        if any_lane(violated):
            feasible, new_x, new_y = linear_program_1(lines, i, opt_x, opt_y, direction_opt, p)
            moves, fails = violated & feasible, violated & ~feasible
            x, y = select(moves, new_x, x), select(moves, new_y, y)
            failed_row = select(fails, i, failed_row)
            active = active & ~fails
    return failed_row, x, y


@inlined
def _project_half_planes(lines, row, projected, p):
    """Writes the half-planes before `row`, seen from the edges of `row`, into `projected`.

    One that points the same way as `row` does not matter; its place is filled with zeros.
    """
    px, py, dx, dy = load_line(lines, row)
    for j in range(row):
        qx, qy, ex, ey = load_line(lines, j)
        determinant = dx * ey - dy * ex
        parallel = abs(determinant) <= p.epsilon
        same_way = parallel & (dx * ex + dy * ey > p.zero)
        t = (ex * (py - qy) - ey * (px - qx)) / determinant
        point_x = select(parallel, p.half * (px + qx), px + t * dx)
        point_y = select(parallel, p.half * (py + qy), py + t * dy)
        new_dx, new_dy = ex - dx, ey - dy
        scale = p.one / root(new_dx * new_dx + new_dy * new_dy)
        store_line(
            projected,
            j,
            select(same_way, p.zero, point_x),
            select(same_way, p.zero, point_y),
            select(same_way, p.zero, new_dx * scale),
            select(same_way, p.zero, new_dy * scale),
        )


@inlined
def linear_program_3(lines, count, failed_row, x, y, projected, p):
    """Velocities that violate the worst half-plane least, where none satisfies all (Section 5.3).

    Args:
      lines: `[max_neighbours, 4, 8]`.
      count: half-planes to look at.
      failed_row, x, y: what the second program gave; robots with `failed_row == count` keep (x, y).
      projected: scratch `[max_neighbours, 4, 8]`.
      p: ORCAParams.

    Returns:
      (x, y).
    """
    distance = splat(p.zero)
    for i in range(count):
        _, _, dir_x, dir_y = load_line(lines, i)
        present = (dir_x != p.zero) | (dir_y != p.zero)  # `distance` may be a rounding error below zero
        worse = present & (failed_row <= i) & (violation(lines, i, x, y) > distance)
        if any_lane(worse):
            _project_half_planes(lines, i, projected, p)
            failed, new_x, new_y = linear_program_2(projected, i, -dir_y, dir_x, worse, True, p)
            solved = worse & (failed == i)
            x, y = select(solved, new_x, x), select(solved, new_y, y)
            distance = select(worse, violation(lines, i, x, y), distance)
    return x, y


@inlined
def build_half_planes(robot, body, neighbours, at, count, lines, p):
    """Writes the half-planes of eight robots.

    Args:
      robot: int32 vector, the robots' rows in `body`.
      body: `[slots, 4]`, position (metres) and velocity (m/s) of the old state.
      neighbours: int32, vectors `at` to `at + count - 1` are rows in `body`, nearest first, -1 for none.
      at, count: see `neighbours`.
      lines: `[max_neighbours, 4, 8]`, written.
      p: ORCAParams.
    """
    x, y, vx, vy = gather_4(body, robot)
    for k in range(count):
        other = load(neighbours, at + k)
        present = other >= 0
        other = select(present, other, robot)
        other_x, other_y, other_vx, other_vy = gather_4(body, other)
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
def orca_velocity(lines, count, pref_x, pref_y, projected, p):
    """ORCA's new velocities of eight robots (Section 5 of the paper).

    Args:
      lines: `[max_neighbours, 4, 8]`, the half-planes, nearest neighbour first.
      count: half-planes to look at.
      pref_x, pref_y: vectors, the robots' preferred velocities, m/s.
      projected: scratch `[max_neighbours, 4, 8]`.
      p: ORCAParams.

    Returns:
      (x, y): the new velocities, m/s, no longer than `p.max_speed_m_s` up to rounding. The third program
      loses digits where half-planes are nearly parallel and can leave the speed disc; its result is set
      back onto it.
    """
    everyone = splat(True)
    failed_row, x, y = linear_program_2(lines, count, pref_x, pref_y, everyone, False, p)
    failed = failed_row < count
    if any_lane(failed):
        x, y = linear_program_3(lines, count, failed_row, x, y, projected, p)
        speed_sq, limit_sq = x * x + y * y, p.max_speed_m_s * p.max_speed_m_s
        too_fast = failed & (speed_sq > limit_sq + limit_sq * p.epsilon)
        scale = p.max_speed_m_s / root(speed_sq)
        x, y = select(too_fast, x * scale, x), select(too_fast, y * scale, y)
    return x, y
