"""Random scenes of robots for ORCA, and masks of the special robots of a scene.

A scene holds positions, velocities and preferred velocities, each `[n, 2]` float32.
"""

from typing import NamedTuple

import numpy as np

MAX_SPEED_M_S = 1.0
MAX_ROBOTS = 300


class Scene(NamedTuple):
    """ORCA's input of one world, `[n, 2]` float32 each: positions (m), velocities and preferred velocities (m/s)."""

    pos: np.ndarray
    vel: np.ndarray
    pref: np.ndarray


def random_scene(kind, rng, n=None):
    """A scene of `kind` (one of KINDS) with `n` robots; by default 2 to 300, log-uniformly distributed."""
    if n is None:
        n = int(np.exp(rng.uniform(np.log(2), np.log(MAX_ROBOTS + 1))))
    pos, vel, pref = SCENES[kind](n, rng)
    return Scene(*(np.asarray(array, np.float32) for array in (pos, vel, pref)))


def numbered_scene(kind, number, n=None):
    """Scene `number` of `kind`; the same arguments always give the same scene."""
    return random_scene(kind, np.random.default_rng([KINDS.index(kind), number]), n)


class WorldScene(NamedTuple):
    """One world of a batch, `[n, 2]` float32 each: positions (m), velocities (m/s) and each robot's goal (m)."""

    pos: np.ndarray
    vel: np.ndarray
    goal: np.ndarray


def world_scene(worlds, world):
    """The WorldScene of one world of a WorldBatch."""
    state = worlds.get_state()
    vel = np.stack([state["vel_x"][world], state["vel_y"][world]], axis=-1)
    return WorldScene(worlds.positions()[world], vel, np.repeat(worlds.goals()[world], worlds.config.robots, axis=0))


def heading_scene(worlds, world, rng):
    """A Scene of one world of a WorldBatch; robots prefer full speed towards their goals, with some noise."""
    pos, vel, goal = world_scene(worlds, world)
    heading = (goal - pos) / np.linalg.norm(goal - pos, axis=1, keepdims=True)
    return Scene(pos, vel, (heading + rng.normal(0, 0.1, pos.shape)).astype(np.float32))


def goal_scene(worlds, world):
    """A Scene of one world of a WorldBatch without flocking, with the kernels' order of operations."""
    pos, vel, goal = world_scene(worlds, world)
    x, y = (goal - pos).T
    length_sq = x * x + y * y
    scale = np.where(length_sq > 1, 1 / np.sqrt(length_sq), np.float32(1))
    return Scene(pos, vel, np.stack([x * scale, y * scale], axis=1))


def _velocities(n, rng):
    """Random velocities within the speed limit, and preferred velocities that may exceed it."""
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
    """A grid with jitter, so dense that every robot touches another."""
    return 0.42 * _grid(n) + rng.uniform(-0.02, 0.02, (n, 2)), *_velocities(n, rng)


def _head_on(n, rng):
    """Two rows of robots that meet head on."""
    side = np.where(np.arange(n) % 2, 1.0, -1.0)
    pos = np.stack([side * rng.uniform(0.25, 0.8, n), rng.uniform(0, 0.6 * np.sqrt(n), n)], axis=1)
    vel = np.stack([-side, rng.normal(0, 1e-3, n)], axis=1)
    return pos, vel, np.stack([-1.2 * side, np.zeros(n)], axis=1)


def _coincident(n, rng):
    """Every third robot has exactly the position of another; half of these have its velocity too."""
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
    """A lattice of exact floats: exact distance ties everywhere, and robots at exactly the range's distance.

    Velocities are random, or on a lattice too, or all equal. Half-planes then coincide or oppose each other.
    """
    pos = _grid(n) * rng.choice([0.25, 0.375, 0.5, 0.75]) + rng.integers(-4, 5, 2)
    vel, pref = _velocities(n, rng)
    choice = rng.integers(3)
    if choice == 1:
        vel, pref = np.clip(np.round(4 * vel) / 4, -0.5, 0.5), np.round(2 * pref) / 2
    if choice == 2:
        vel = np.tile(np.round(4 * vel[:1]) / 4, (n, 1))
    return pos, vel, pref


def _rotated_lattice(n, rng):
    """A lattice rotated by a random angle: its ties and parallels are exact up to rounding."""
    angle = rng.uniform(0, 2 * np.pi)
    rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return tuple(array @ rotation for array in _lattice(n, rng))


def _patches(n, rng):
    """Clusters of 1 to 12 robots out of each other's range: robots with few neighbours beside robots with many."""
    patch = np.searchsorted(np.cumsum(rng.integers(1, 13, n)), np.arange(n), side="right")
    centre = 4.0 * _grid(n)[patch]
    pos = centre + rng.choice([0.1, 0.25, 0.5]) * rng.normal(0, 1, (n, 2))
    order = rng.permutation(n)
    return pos[order], *_velocities(n, rng)


def _crossing(n, rng):
    """Two to eight groups that cross at one point."""
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
    "coincident": _coincident,
    "at rest": _at_rest,
    "lattice": _lattice,
    "rotated lattice": _rotated_lattice,
    "crossing": _crossing,
    "patches": _patches,
}
KINDS = tuple(SCENES)
GENERIC_KINDS = tuple(kind for kind in KINDS if kind not in ("coincident", "lattice", "rotated lattice"))
"""Kinds whose robots almost never coincide, tie or have parallel half-planes."""


def distances_sq(pos):
    """Squared distances `[n, n]` between all robots in the dtype of `pos`; infinity on the diagonal."""
    delta = pos[:, None] - pos[None]
    dist_sq = delta[..., 0] * delta[..., 0] + delta[..., 1] * delta[..., 1]
    np.fill_diagonal(dist_sq, np.inf)
    return dist_sq


def tie_margin_sq(pos, range_m=1.5, max_neighbours=10):
    """Per robot, the smallest difference between two squared distances in its neighbour list, m^2.

    The first robot that does not fit into the list counts too. Where the difference is 0 (a tie), the kernels order the
    two neighbours by index and RVO2 by its tree.
    """
    dist_sq = distances_sq(pos)
    nearest = np.sort(np.where(dist_sq < pos.dtype.type(range_m) ** 2, dist_sq, np.inf), axis=1)
    nearest = nearest[:, : max_neighbours + 1]
    first, second = nearest[:, :-1], nearest[:, 1:]
    gaps = np.where(np.isfinite(second), second - np.where(np.isfinite(first), first, 0), np.inf)
    return gaps.min(axis=1, initial=np.inf)


def range_margin_sq(pos, range_m=1.5):
    """Per robot, the smallest difference between another one's squared distance and the squared range, m^2."""
    return np.abs(distances_sq(pos) - range_m**2).min(axis=1)


def coincides(pos):
    """Per robot, whether another one has the same position."""
    return (distances_sq(pos) == 0).any(axis=1)
