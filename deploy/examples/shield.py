"""The shield of an exported policy in numpy alone: the permitted velocity nearest to the one that the policy asks for.

Every sensed robot within range forbids a half-plane of velocities (ORCA, van den Berg et al. 2011, Section 4). The
nearest permitted velocity is a corner of what is left, or the nearest point of one edge, so all of them are tried.
Where nothing is left, the velocity is taken that violates the half-planes least.

    velocity = shielded(asked, velocity, positions, velocities, about["shield"])
"""

import itertools
from typing import Any

import numpy as np

EPSILON = 1e-9


def half_planes(velocity: Any, positions: Any, velocities: Any, shield: Any) -> tuple[Any, Any]:
    """(normals `[n, 2]`, offsets `[n]`): a velocity v is permitted where normals @ v >= offsets.

    Positions are relative to the robot; velocities `[n, 2]` and the robot's own `velocity` `[2]` are not.
    """
    normals, offsets, radius = [], [], 2 * shield["radius_m"]
    for position, other in zip(positions, velocities, strict=True):
        distance, relative = np.hypot(*position), velocity - other
        if not distance < shield["range_m"]:
            continue
        tau = shield["horizon_s"] if distance > radius else shield["time_step_s"]
        away = relative - position / tau  # from the centre of the cut-off circle, whose radius is radius / tau
        length, ahead = np.hypot(*away), away @ position
        if distance <= radius or (ahead < 0 and ahead**2 > radius**2 * length**2):
            normal = away / length if length > EPSILON else np.array([1.0, 0.0])
            change = (radius / tau - length) * normal
        else:
            side = 1.0 if position[0] * away[1] - position[1] * away[0] > 0 else -1.0
            leg, across = np.sqrt(distance**2 - radius**2) / distance**2, side * radius / distance**2
            along = leg * position + across * np.array([-position[1], position[0]])
            normal, change = side * np.array([-along[1], along[0]]), (relative @ along) * along - relative
        normals.append(normal)
        offsets.append(normal @ (velocity + shield["responsibility"] * change))
    return np.reshape(normals, (-1, 2)), np.array(offsets)


def on_circle(normals: Any, offsets: Any, speed: float) -> Any:
    """Points `[m, 2]` with the given speed on the lines normals @ v = offsets, whose normals may have any length."""
    length = np.hypot(normals[:, 0], normals[:, 1])
    cuts = (length > EPSILON) & (np.abs(offsets) <= speed * length)
    normal, foot = normals[cuts] / length[cuts, None], offsets[cuts] / length[cuts]
    along = np.sqrt(np.maximum(speed**2 - foot**2, 0.0))[:, None] * np.stack([-normal[:, 1], normal[:, 0]], axis=1)
    return np.concatenate([foot[:, None] * normal + along, foot[:, None] * normal - along])


def solved(matrices: Any, right: Any) -> Any:
    """Solutions of the regular ones of many systems."""
    regular = np.abs(np.linalg.det(matrices)) > EPSILON
    return np.linalg.solve(matrices[regular], right[regular][..., None])[..., 0]


def several(count: int, size: int) -> Any:
    """All choices of `size` of `count` half-planes."""
    return np.array(list(itertools.combinations(range(count), size)), int).reshape(-1, size)


def shielded(asked: Any, velocity: Any, positions: Any, velocities: Any, shield: Any) -> Any:
    """The velocity `[2]` (m/s) to drive.

    Args:
      asked: what the policy asks for `[2]`.
      velocity: the robot's present velocity `[2]`.
      positions: of the other robots `[n, 2]`, relative to the robot, metres.
      velocities: of the other robots `[n, 2]`.
      shield: `shield` of the policy's `policy.json`.
    """
    asked = np.asarray(asked, float)
    normals, offsets = half_planes(velocity, np.asarray(positions, float), velocities, shield)
    speed, pairs = shield["top_speed_m_s"], several(len(normals), 2)
    shortened = asked * min(1.0, speed / max(np.hypot(*asked), EPSILON))
    edges = asked + (offsets - normals @ asked)[:, None] * normals
    tried = [shortened[None], edges, on_circle(normals, offsets, speed), solved(normals[pairs], offsets[pairs])]
    points = np.concatenate(tried)
    permitted = ((points @ normals.T >= offsets - EPSILON).all(axis=1)) & (np.hypot(*points.T) <= speed + EPSILON)
    if permitted.any():
        return points[permitted][np.hypot(*(points[permitted] - asked).T).argmin()]
    triples = several(len(normals), 3)
    systems = np.concatenate([normals[triples], np.ones((*triples.shape, 1))], axis=2)  # as far outside of all three
    outside = [
        speed * normals,
        on_circle(normals[pairs[:, 0]] - normals[pairs[:, 1]], offsets[pairs[:, 0]] - offsets[pairs[:, 1]], speed),
        (offsets[pairs[:, 0]] * normals[pairs[:, 0]].T).T / 2 + (offsets[pairs[:, 1]] * normals[pairs[:, 1]].T).T / 2,
        solved(systems, offsets[triples])[:, :2],
    ]
    points = np.concatenate(outside)
    points = points[np.hypot(*points.T) <= speed + EPSILON]
    return points[(offsets - points @ normals.T).max(axis=1).argmin()]
