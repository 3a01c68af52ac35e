"""ORCA's half-planes and linear programs by geometry and by enumeration of all candidate points, in float64.

A half-plane is a row (point, unit direction d) of `[count, 4]`, in m/s; its violation at the velocity v is
det(d, point - v) = offset - n . v with the inward normal n = (-d_y, d_x).
"""

import itertools
from typing import NamedTuple

import numpy as np

TIME_STEP_S = 0.05


class Clearance(NamedTuple):
    """What a robot keeps free: discs of `radius_m` for `horizon_s`, of the robots nearer than `range_m`."""

    radius_m: float
    horizon_s: float
    range_m: float


def half_planes(pos, vel, robot, clearance):
    """The half-planes of a robot that takes all of the avoidance (van den Berg et al. 2011, Fig. 1 and 3).

    Args:
      pos, vel: `[n, 2]`, metres and m/s.
      robot: whose.
      clearance: what it keeps free.
    """
    pos, vel = np.asarray(pos, float), np.asarray(vel, float)
    lines, radius = [], 2 * clearance.radius_m
    for other in range(len(pos)):
        p, v = pos[other] - pos[robot], vel[robot] - vel[other]
        distance = np.linalg.norm(p)
        if other == robot or not distance < clearance.range_m:
            continue
        tau = clearance.horizon_s if distance > radius else TIME_STEP_S
        disc, disc_radius = p / tau, radius / tau
        away = v - disc
        nearest = disc + away / np.linalg.norm(away) * disc_radius  # on the cut-off circle
        outward = away / np.linalg.norm(away)
        leg = np.arccos(np.clip(disc @ (disc - nearest) / np.linalg.norm(disc) / disc_radius, -1, 1))
        if distance > radius and leg > np.arccos(radius / distance):  # the nearest point is on a leg
            side = 1 if p[0] * away[1] - p[1] * away[0] > 0 else -1
            angle = side * np.arcsin(radius / distance)
            cos, sin = np.cos(angle), np.sin(angle)
            along = np.array([cos * p[0] - sin * p[1], sin * p[0] + cos * p[1]]) / distance
            nearest, outward = (v @ along) * along, side * np.array([-along[1], along[0]])
        point = vel[robot] + (nearest - v)
        lines.append([*point, outward[1], -outward[0]])
    return np.array(lines).reshape(-1, 4)


def normals_and_offsets(lines):
    """Inward unit normals `[count, 2]` and offsets `[count]`: violation = offset - normal . v."""
    normal = np.column_stack([-lines[:, 3], lines[:, 2]])
    return normal, np.einsum("ij,ij->i", normal, lines[:, :2])


def violation(lines, v):
    """The largest violation `[...]` of the velocities v `[..., 2]`."""
    normal, offset = normals_and_offsets(lines)
    return (offset - np.asarray(v) @ normal.T).max(axis=-1)


def on_circle(normal, offset, limit):
    """The points of the circle |v| = limit with normal . v = offset; the normal may have any length."""
    length = np.linalg.norm(normal)
    if length < 1e-12 or abs(offset) > limit * length:
        return []
    foot, along = normal * offset / length**2, np.array([-normal[1], normal[0]]) / length
    half = np.sqrt(max(limit**2 - foot @ foot, 0.0))
    return [foot + half * along, foot - half * along]


def closest_permitted(lines, limit, opt):
    """The permitted velocity closest to `opt`, or None: the best of all points where the optimum can lie."""
    normal, offset = normals_and_offsets(lines)
    length = np.linalg.norm(opt)
    points = [opt if length <= limit else opt / length * limit]
    for i in range(len(lines)):
        points.append(opt + (offset[i] - normal[i] @ opt) * normal[i])
        points += on_circle(normal[i], offset[i], limit)
    for i, j in itertools.combinations(range(len(lines)), 2):
        pair = normal[[i, j]]
        if abs(np.linalg.det(pair)) > 1e-12:
            points.append(np.linalg.solve(pair, offset[[i, j]]))
    points = np.array(points)
    permitted = (violation(lines, points) < 1e-9) & (np.linalg.norm(points, axis=1) < limit + 1e-9)
    if not permitted.any():
        return None
    return min(points[permitted], key=lambda v: np.linalg.norm(v - opt))


def least_violation(lines, limit):
    """The minimum over the disc of the largest violation: the best of all points where the optimum can lie."""
    normal, offset = normals_and_offsets(lines)
    points = list(limit * normal)
    for i, j in itertools.combinations(range(len(lines)), 2):
        points += on_circle(normal[i] - normal[j], offset[i] - offset[j], limit)
        points.append(0.5 * (lines[i, :2] + lines[j, :2]))  # needed for antiparallel pairs
    for triple in itertools.combinations(range(len(lines)), 3):
        system = np.column_stack([normal[list(triple)], np.ones(3)])
        if abs(np.linalg.det(system)) > 1e-12:
            points.append(np.linalg.solve(system, offset[list(triple)])[:2])
    points = np.array(points)
    inside = np.linalg.norm(points, axis=1) <= limit + 1e-9
    return violation(lines, points[inside]).min()
