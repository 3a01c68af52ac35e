"""ORCA for discs: half-planes and the linear programs of van den Berg et al. (2011).

J. van den Berg, S. J. Guy, M. Lin, D. Manocha, "Reciprocal n-body collision avoidance", ISRR 2011.
A half-plane is a point and a unit direction; permitted velocities lie to its left. Half-planes are
rows of a scratch array `lines` `[max_neighbours, 4]`: point x, point y, direction x, direction y.
Kernels compute in the dtype of their arguments (float32 in the worlds), allocate nothing, and take
every constant from `ORCAParams` so that no float64 literal widens the arithmetic. The order of operations
is that of the reference implementation (RVO2), reciprocals included, so that float32 results are equal to
its own; exceptions are robots that coincide and the speed limit (see `orca_velocity`), where it fails.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sim_core.jit import kernel

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


@kernel
def half_plane(rel_x, rel_y, rel_vx, rel_vy, vx, vy, tie_sign, p, lines, row):
    """Writes the ORCA half-plane that one neighbour imposes into `lines[row]` (Section 4 of the paper).

    Args:
      rel_x, rel_y: the neighbour's position relative to the robot, metres.
      rel_vx, rel_vy: the robot's velocity relative to the neighbour, m/s.
      vx, vy: the robot's velocity, m/s.
      tie_sign: +1 or -1, opposite for the two robots of a pair; side taken when they coincide.
      p: ORCAParams.
      lines: scratch `[max_neighbours, 4]`.
      row: row to write.
    """
    dist_sq = rel_x * rel_x + rel_y * rel_y
    radius = p.combined_radius_m
    radius_sq = radius * radius
    apart = dist_sq > radius_sq
    inverse_time = p.inverse_horizon_1_s if apart else p.inverse_time_step_1_s
    w_x = rel_vx - inverse_time * rel_x
    w_y = rel_vy - inverse_time * rel_y
    w_sq = w_x * w_x + w_y * w_y
    dot = w_x * rel_x + w_y * rel_y
    if not apart or (dot < p.zero and dot * dot > radius_sq * w_sq):
        w_length = np.sqrt(w_sq)
        unit_x, unit_y = tie_sign, p.zero
        if w_length > p.epsilon * p.epsilon * p.epsilon:  # below it, squares underflow: no direction is left
            scale = p.one / w_length
            unit_x, unit_y = w_x * scale, w_y * scale
        dir_x, dir_y = unit_y, -unit_x
        push = radius * inverse_time - w_length
        u_x, u_y = push * unit_x, push * unit_y
    else:
        leg = np.sqrt(dist_sq - radius_sq)
        scale = p.one / dist_sq
        if rel_x * w_y - rel_y * w_x > p.zero:
            dir_x = (rel_x * leg - rel_y * radius) * scale
            dir_y = (rel_x * radius + rel_y * leg) * scale
        else:
            dir_x = -(rel_x * leg + rel_y * radius) * scale
            dir_y = -(rel_y * leg - rel_x * radius) * scale
        along = rel_vx * dir_x + rel_vy * dir_y
        u_x, u_y = along * dir_x - rel_vx, along * dir_y - rel_vy
    lines[row, 0] = vx + p.half * u_x
    lines[row, 1] = vy + p.half * u_y
    lines[row, 2] = dir_x
    lines[row, 3] = dir_y


@kernel
def linear_program_1(lines, row, max_speed, opt_x, opt_y, direction_opt, p):
    """Optimises along the edge of half-plane `row`, under the half-planes before it and the speed disc.

    Returns:
      (feasible, x, y): the velocity on the edge nearest to `opt` (or farthest along it if
      `direction_opt`); meaningless if not feasible.
    """
    px, py, dx, dy = lines[row, 0], lines[row, 1], lines[row, 2], lines[row, 3]
    dot = px * dx + py * dy
    discriminant = dot * dot + max_speed * max_speed - (px * px + py * py)
    if discriminant < p.zero:
        return False, opt_x, opt_y
    root = np.sqrt(discriminant)
    t_left = -dot - root
    t_right = -dot + root
    for i in range(row):
        denominator = dx * lines[i, 3] - dy * lines[i, 2]
        numerator = lines[i, 2] * (py - lines[i, 1]) - lines[i, 3] * (px - lines[i, 0])
        if abs(denominator) <= p.epsilon:
            if numerator < p.zero:
                return False, opt_x, opt_y
            continue
        t = numerator / denominator
        if denominator >= p.zero:
            t_right = min(t_right, t)
        else:
            t_left = max(t_left, t)
        if t_left > t_right:
            return False, opt_x, opt_y
    if direction_opt:
        t = t_right if opt_x * dx + opt_y * dy > p.zero else t_left
    else:
        t = min(max(dx * (opt_x - px) + dy * (opt_y - py), t_left), t_right)
    return True, px + t * dx, py + t * dy


@kernel
def linear_program_2(lines, count, max_speed, opt_x, opt_y, direction_opt, p):
    """Velocity nearest to `opt` in the intersection of `count` half-planes and the speed disc.

    Returns:
      (failed_row, x, y): `failed_row == count` if feasible, else the first half-plane that could not
      be satisfied, with the optimum under those before it.
    """
    opt_sq = opt_x * opt_x + opt_y * opt_y
    if direction_opt:
        x, y = opt_x * max_speed, opt_y * max_speed
    elif opt_sq > max_speed * max_speed:
        scale = p.one / np.sqrt(opt_sq)
        x, y = opt_x * scale * max_speed, opt_y * scale * max_speed
    else:
        x, y = opt_x, opt_y
    for i in range(count):
        if lines[i, 2] * (lines[i, 1] - y) - lines[i, 3] * (lines[i, 0] - x) > p.zero:
            feasible, new_x, new_y = linear_program_1(lines, i, max_speed, opt_x, opt_y, direction_opt, p)
            if not feasible:
                return i, x, y
            x, y = new_x, new_y
    return count, x, y


@kernel
def _project_half_planes(lines, row, projected, p):
    """Writes the half-planes before `row`, seen from the edge of `row`, into `projected`; returns their count."""
    count = 0
    dx, dy = lines[row, 2], lines[row, 3]
    for j in range(row):
        determinant = dx * lines[j, 3] - dy * lines[j, 2]
        if abs(determinant) <= p.epsilon:
            if dx * lines[j, 2] + dy * lines[j, 3] > p.zero:
                continue
            projected[count, 0] = p.half * (lines[row, 0] + lines[j, 0])
            projected[count, 1] = p.half * (lines[row, 1] + lines[j, 1])
        else:
            offset = lines[j, 2] * (lines[row, 1] - lines[j, 1]) - lines[j, 3] * (lines[row, 0] - lines[j, 0])
            t = offset / determinant
            projected[count, 0] = lines[row, 0] + t * dx
            projected[count, 1] = lines[row, 1] + t * dy
        new_dx, new_dy = lines[j, 2] - dx, lines[j, 3] - dy
        scale = p.one / np.sqrt(new_dx * new_dx + new_dy * new_dy)
        projected[count, 2] = new_dx * scale
        projected[count, 3] = new_dy * scale
        count += 1
    return count


@kernel
def linear_program_3(lines, count, failed_row, max_speed, x, y, projected, p):
    """Velocity that violates the worst half-plane least, when no velocity satisfies all (Section 5.3)."""
    distance = p.zero
    for i in range(failed_row, count):
        violation = lines[i, 2] * (lines[i, 1] - y) - lines[i, 3] * (lines[i, 0] - x)
        if violation > distance:
            projected_count = _project_half_planes(lines, i, projected, p)
            failed, new_x, new_y = linear_program_2(
                projected, projected_count, max_speed, -lines[i, 3], lines[i, 2], True, p
            )
            if failed == projected_count:
                x, y = new_x, new_y
            distance = lines[i, 2] * (lines[i, 1] - y) - lines[i, 3] * (lines[i, 0] - x)
    return x, y


@kernel
def orca_velocity(robot, pos_x, pos_y, vel_x, vel_y, neighbours, count, pref_x, pref_y, lines, projected, p):
    """ORCA's new velocity of one robot (Section 5 of the paper).

    Args:
      robot: index of the robot.
      pos_x, pos_y, vel_x, vel_y: `[num_robots]`, one world's old state, metres and m/s.
      neighbours: `[max_neighbours]` int32, nearest first; the first `count` are used.
      count: number of neighbours.
      pref_x, pref_y: the robot's preferred velocity, m/s.
      lines, projected: scratch `[max_neighbours, 4]`.
      p: ORCAParams.

    Returns:
      (x, y): the new velocity, m/s, no longer than `p.max_speed_m_s` up to rounding. The third program
      loses digits where half-planes are nearly parallel and can leave the speed disc; its result is set
      back onto it.
    """
    for k in range(count):
        other = neighbours[k]
        tie_sign = p.one if robot < other else -p.one
        half_plane(
            pos_x[other] - pos_x[robot],
            pos_y[other] - pos_y[robot],
            vel_x[robot] - vel_x[other],
            vel_y[robot] - vel_y[other],
            vel_x[robot],
            vel_y[robot],
            tie_sign,
            p,
            lines,
            k,
        )
    failed, x, y = linear_program_2(lines, count, p.max_speed_m_s, pref_x, pref_y, False, p)
    if failed < count:
        x, y = linear_program_3(lines, count, failed, p.max_speed_m_s, x, y, projected, p)
        speed_sq, limit_sq = x * x + y * y, p.max_speed_m_s * p.max_speed_m_s
        if speed_sq > limit_sq + limit_sq * p.epsilon:
            scale = p.max_speed_m_s / np.sqrt(speed_sq)
            x, y = x * scale, y * scale
    return x, y
