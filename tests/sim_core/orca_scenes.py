"""Random scenes of robots for ORCA, and which robots of a scene are special.

A scene is positions, velocities and preferred velocities, each `[n, 2]` float32.
"""

from typing import NamedTuple

import numpy as np

MAX_SPEED_M_S = 1.0
MOST_ROBOTS = 300


class Scene(NamedTuple):
    """One world's robots as ORCA sees them, `[n, 2]` float32 each: m, m/s, m/s."""

    pos: np.ndarray
    vel: np.ndarray
    pref: np.ndarray


def random_scene(kind, rng, n=None):
    """A scene of `kind` (one of KINDS) with `n` robots; by default 2 to 300, small worlds as often as large."""
    if n is None:
        n = int(np.exp(rng.uniform(np.log(2), np.log(MOST_ROBOTS + 1))))
    pos, vel, pref = SCENES[kind](n, rng)
    return Scene(*(np.asarray(array, np.float32) for array in (pos, vel, pref)))


def numbered_scene(kind, number, n=None):
    """Scene `number` of `kind`: the same one whenever it is asked for."""
    return random_scene(kind, np.random.default_rng([KINDS.index(kind), number]), n)


class WorldScene(NamedTuple):
    """One world of a batch, `[n, 2]` float32 each: m, m/s, and each robot's own goal, m."""

    pos: np.ndarray
    vel: np.ndarray
    goal: np.ndarray


def world_scene(worlds, world):
    """Where the robots of a world of a WorldBatch are, how they move and where they want to go."""
    state = worlds.get_state()
    vel = np.stack([state["vel_x"][world], state["vel_y"][world]], axis=-1)
    return WorldScene(worlds.positions()[world], vel, np.repeat(worlds.goals()[world], worlds.config.robots, axis=0))


def heading_scene(worlds, world, rng):
    """A world of a WorldBatch as ORCA's scene: robots prefer full speed towards their goal, with some noise."""
    pos, vel, goal = world_scene(worlds, world)
    heading = (goal - pos) / np.linalg.norm(goal - pos, axis=1, keepdims=True)
    return Scene(pos, vel, (heading + rng.normal(0, 0.1, pos.shape)).astype(np.float32))


def goal_scene(worlds, world):
    """A world of a WorldBatch without flocking as ORCA's scene, in the order of operations of the worlds."""
    pos, vel, goal = world_scene(worlds, world)
    x, y = (goal - pos).T
    length_sq = x * x + y * y
    scale = np.where(length_sq > 1, 1 / np.sqrt(length_sq), np.float32(1))
    return Scene(pos, vel, np.stack([x * scale, y * scale], axis=1))


def _velocities(n, rng):
    """Random velocities no faster than the limit, and preferred ones that may be."""
    vel = rng.normal(0, 0.5, (n, 2))
    vel *= np.minimum(1, MAX_SPEED_M_S / np.linalg.norm(vel, axis=1, keepdims=True))
    return vel, rng.normal(0, 0.7, (n, 2))


def _scattered(spacing_m):
    def scene(n, rng):
        return rng.uniform(0, spacing_m * np.sqrt(n), (n, 2)), *_velocities(n, rng)

    return scene


def _grid(n):
    return np.stack(np.divmod(np.arange(n), int(np.ceil(np.sqrt(n)))), axis=1)


def _jammed(n, rng):
    """A shaken grid: everybody touches somebody."""
    return 0.42 * _grid(n) + rng.uniform(-0.02, 0.02, (n, 2)), *_velocities(n, rng)


def _head_on(n, rng):
    """Two walls that run into each other."""
    side = np.where(np.arange(n) % 2, 1.0, -1.0)
    pos = np.stack([side * rng.uniform(0.25, 0.8, n), rng.uniform(0, 0.6 * np.sqrt(n), n)], axis=1)
    vel = np.stack([-side, rng.normal(0, 1e-3, n)], axis=1)
    return pos, vel, np.stack([-1.2 * side, np.zeros(n)], axis=1)


def _same_place(n, rng):
    """Every third robot stands exactly where another one does; half of those share its velocity too."""
    pos, vel, pref = _scattered(0.5)(n, rng)
    pos, vel = pos.astype(np.float32), vel.astype(np.float32)
    for i in range(0, n, 3):
        other = int(rng.integers(n))
        pos[i] = pos[other]
        if rng.random() < 0.5:
            vel[i] = vel[other]
    return pos, vel, pref


def _at_rest(n, rng):
    pos, _, pref = _scattered(0.45)(n, rng)
    return pos, np.zeros((n, 2)), pref


def _lattice(n, rng):
    """Multiples of a power of two: exact distance ties everywhere, and robots exactly at the range's end.

    Velocities are random, on a lattice too, or all the same, so that half-planes coincide or oppose each other.
    """
    pos = _grid(n) * rng.choice([0.25, 0.375, 0.5, 0.75]) + rng.integers(-4, 5, 2)
    vel, pref = _velocities(n, rng)
    choice = rng.integers(3)
    if choice == 1:
        vel, pref = np.clip(np.round(4 * vel) / 4, -0.5, 0.5), np.round(2 * pref) / 2
    if choice == 2:
        vel = np.tile(np.round(4 * vel[:1]) / 4, (n, 1))
    return pos, vel, pref


def _turned_lattice(n, rng):
    """A lattice turned by any angle: everything that ties or is parallel there is so but for rounding."""
    angle = rng.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return tuple(array @ turn for array in _lattice(n, rng))


def _patches(n, rng):
    """Heaps of one to twelve robots out of each other's range: robots with few neighbours beside some with many."""
    patch = np.searchsorted(np.cumsum(rng.integers(1, 13, n)), np.arange(n), side="right")
    centre = 4.0 * _grid(n)[patch]
    pos = centre + rng.choice([0.1, 0.25, 0.5]) * rng.normal(0, 1, (n, 2))
    order = rng.permutation(n)
    return pos[order], *_velocities(n, rng)


def _crossing(n, rng):
    """Two to eight groups on their way through one place."""
    groups = int(rng.integers(2, 9))
    angle = rng.uniform(0, 2 * np.pi) + 2 * np.pi * (np.arange(n) % groups) / groups
    outwards = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    spread_m = 0.25 * np.sqrt(n / groups)
    pos = rng.uniform(0.5, 2.0) * spread_m * outwards + rng.uniform(-spread_m, spread_m, (n, 2))
    vel = -outwards * rng.uniform(0.3, 0.95, (n, 1)) + rng.normal(0, 0.03, (n, 2))
    return pos, vel, -outwards + rng.normal(0, 0.1, (n, 2))


SCENES = {
    "sparse": _scattered(1.5),
    "jammed": _jammed,
    "overlapping": _scattered(0.2),
    "head-on": _head_on,
    "same place": _same_place,
    "at rest": _at_rest,
    "lattice": _lattice,
    "turned lattice": _turned_lattice,
    "crossing": _crossing,
    "patches": _patches,
}
KINDS = tuple(SCENES)
GENERIC_KINDS = tuple(kind for kind in KINDS if kind not in ("same place", "lattice", "turned lattice"))
"""Kinds whose robots neither coincide nor tie nor have parallel half-planes, but by a rare chance."""


def distances_sq(pos):
    """Squared distances `[n, n]` between all robots in the dtype of `pos`, infinite to oneself."""
    delta = pos[:, None] - pos[None]
    dist_sq = delta[..., 0] * delta[..., 0] + delta[..., 1] * delta[..., 1]
    np.fill_diagonal(dist_sq, np.inf)
    return dist_sq


def tie_margin_sq(pos, range_m=1.5, max_neighbours=10):
    """Per robot, the smallest difference of two squared distances that fill or bound its neighbour list, m^2.

    Where it is 0 (a tie), the worlds order the two neighbours by index and RVO2 by its tree.
    """
    dist_sq = distances_sq(pos)
    nearest = np.sort(np.where(dist_sq < pos.dtype.type(range_m) ** 2, dist_sq, np.inf), axis=1)
    nearest = nearest[:, : max_neighbours + 1]
    first, second = nearest[:, :-1], nearest[:, 1:]
    gaps = np.where(np.isfinite(second), second - np.where(np.isfinite(first), first, 0), np.inf)
    return gaps.min(axis=1, initial=np.inf)


def range_margin_sq(pos, range_m=1.5):
    """Per robot, how near another one is to the edge of its neighbour range, in squared distances, m^2."""
    return np.abs(distances_sq(pos) - range_m**2).min(axis=1)


def coincides(pos):
    """Per robot, whether another one stands in the same place."""
    return (distances_sq(pos) == 0).any(axis=1)
