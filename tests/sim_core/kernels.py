"""Doors from the tests to the kernels, which work on vectors of eight that Python never sees.

A single problem goes into one lane; the other lanes hold decoys, so that a lane that looked at its
neighbour's numbers would be found out.
"""

from typing import NamedTuple

import numpy as np

from sim_core.jit import kernel
from sim_core.lanes import LANES, gather, load, scatter, splat, store
from sim_core.orca import build_half_planes, linear_program_2, linear_program_3, orca_params, orca_velocity
from sim_core.swarm.flocking import finish_separation, look, preferred_velocity, weighted_sum
from sim_core.swarm.grid import CELLS_PER_RANGE, arrange
from sim_core.swarm.neighbours import find_neighbours, neighbour_params
from sim_core.swarm.step import find_flock_terms
from sim_core.swarm.tile import empty_tile


class OrcaStep(NamedTuple):
    """ORCA's new velocities `[n, 2]`, and of each robot its half-planes `[count, 4]` and neighbours `[count]`."""

    velocity: np.ndarray
    planes: list[np.ndarray]
    neighbours: list[np.ndarray]


@kernel
def _orca_rows(num_slots, rows, tile, pref_x, pref_y, planes, near, orca):
    for row in range(rows):
        find_neighbours(row, 0, num_slots, num_slots, tile, near)
    for row in range(rows):
        robot, count = load(tile.order, row), tile.counts[row]
        wish_x, wish_y = gather(pref_x, robot), gather(pref_y, robot)
        build_half_planes(robot, tile.body, tile.neighbours, row * near.capacity, count, tile.lines, orca)
        x, y = orca_velocity(tile.lines, count, wish_x, wish_y, tile.projected, orca)
        scatter(tile.new_vx, robot, x)
        scatter(tile.new_vy, robot, y)
        for i in range(4 * count):
            store(planes, 4 * near.capacity * row + i, load(tile.lines, i))


@kernel
def _arrange(num_slots, tile, edge_m):
    return arrange(num_slots, tile, edge_m)


def arranged(pos, edge_m, real=np.float32):
    """(tile, rows) of one world's robots, sorted into a grid of cells of `edge_m` or longer.

    Whatever `arrange` has to write holds nonsense before.
    """
    n = len(pos)
    tile = empty_tile(n, n, 1, real)
    tile.body[:n, :2] = pos
    for array in (tile.order, tile.seen_slot, *tile.grid):
        array[:] = -99
    return tile, _arrange(n, tile, float(edge_m))


def _world_tile(pos, vel, max_neighbours, reach_m, hidden, real, edge_m=None):
    """(tile, rows) of one world's robots; searched by grid if `edge_m`, the edge of its cells, is given."""
    n = len(pos)
    rows = -(-n // LANES)
    tile = empty_tile(*((rows * LANES, rows) if edge_m is None else (n, n)), max_neighbours, real)
    tile.body[:n, :2], tile.body[:n, 2:] = pos, vel
    tile.seen_x[:n], tile.seen_y[:n] = np.transpose(pos)
    tile.reach_sq[:] = real(reach_m) ** 2
    if edge_m is not None:
        rows = _arrange(n, tile, edge_m)
    if hidden >= 0:
        tile.seen_x[hidden if edge_m is None else tile.grid.place[hidden]] = np.nan
    return tile, rows


def orca_step(
    pos,
    vel,
    pref,
    *,
    real=np.float32,
    radius_m=0.2,
    horizon_s=2.0,
    time_step_s=0.05,
    max_speed_m_s=1.0,
    range_m=1.5,
    max_neighbours=10,
    hidden=-1,
    reach_m=None,
    grid=False,
    remembered=None,
):
    """ORCA's step of one world's robots, computed in `real`.

    Args:
      pos, vel, pref: `[n, 2]`, positions (m), velocities and preferred velocities (m/s).
      real: np.float32 or np.float64.
      hidden: a robot that nobody perceives, or -1.
      reach_m: where the search for neighbours begins, the whole range by default.
      grid: whether neighbours are searched by grid, as in large worlds.
      remembered: `[n, max_neighbours]`, the robots' lists of the step before, -1 for none; empty by default.
    """
    pos, vel, pref = (np.asarray(array, real) for array in (pos, vel, pref))
    n = len(pos)
    edge_m = range_m / CELLS_PER_RANGE if grid else None
    tile, rows = _world_tile(pos, vel, max_neighbours, range_m if reach_m is None else reach_m, hidden, real, edge_m)
    if remembered is not None:
        lists = np.full((rows * LANES, max_neighbours), -1)
        lists[:n] = remembered
        tile.neighbours[0] = lists.reshape(rows, LANES, max_neighbours).transpose(0, 2, 1)
    padded = np.zeros((2, len(tile.body)), real)
    padded[:, :n] = pref.T
    planes = np.zeros((rows, max_neighbours, 4, LANES), real)
    near = neighbour_params(max_neighbours, range_m, 0.1, real, grid=grid)
    orca = orca_params(radius_m, horizon_s, time_step_s, max_speed_m_s, real)
    _orca_rows(n, rows, tile, *padded, planes, near, orca)
    lane_of = np.argsort(tile.order[:rows].ravel(), kind="stable")[:n]  # the robots, then nobody
    neighbours = tile.neighbours[0, :rows].transpose(0, 2, 1).reshape(-1, max_neighbours)[lane_of]
    lines = planes.transpose(0, 3, 1, 2).reshape(-1, max_neighbours, 4)[lane_of]
    assert not lines[neighbours < 0].any()
    counts = (neighbours >= 0).sum(1)
    return OrcaStep(
        np.stack([tile.new_vx[:n], tile.new_vy[:n]], axis=1),
        [row[:count] for row, count in zip(lines, counts, strict=True)],
        [row[:count] for row, count in zip(neighbours, counts, strict=True)],
    )


def orca_velocities(pos, vel, pref, **settings):
    """ORCA's new velocities `[n, 2]`; see `orca_step`."""
    return orca_step(pos, vel, pref, **settings).velocity


def _in_lane(problem, lane):
    """`[..., 8]`: the problem in its lane, turned copies of it in the others."""
    problem = np.asarray(problem, np.float64)
    points = problem.reshape(*problem.shape[:-1], -1, 2)
    angle = 0.7 * (np.arange(LANES) - lane)
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = points[..., 0, None], points[..., 1, None]
    turned = np.stack([x * cos - y * sin, x * sin + y * cos], axis=-2)
    return np.ascontiguousarray(turned.reshape(*problem.shape, LANES))


@kernel
def _second_program(lines, opt, direction_opt, rows, found, p):
    count = lines.shape[0]
    row, x, y = linear_program_2(lines, count, load(opt, 0), load(opt, 1), splat(True), direction_opt, p)
    store(rows, 0, row)
    store(found, 0, x)
    store(found, 1, y)


@kernel
def _third_program(lines, rows, found, projected, p):
    x, y = linear_program_3(lines, lines.shape[0], load(rows, 0), load(found, 0), load(found, 1), projected, p)
    store(found, 0, x)
    store(found, 1, y)


def second_program(lines, opt, direction_opt, p, lane=3):
    """(failed row, velocity `[2]`) of one problem with half-planes `[count, 4]`, float64."""
    rows, found = np.zeros(LANES, np.int32), np.zeros((2, LANES))
    _second_program(_in_lane(lines, lane), _in_lane(opt, lane), direction_opt, rows, found, p)
    return int(rows[lane]), found[:, lane]


def third_program(lines, failed_row, velocity, p, lane=5):
    """Velocity `[2]` of the third program after the second one stopped at `failed_row` with `velocity`."""
    rows, found = np.full(LANES, failed_row, np.int32), _in_lane(velocity, lane)
    planes = _in_lane(lines, lane)
    _third_program(planes, rows, found, np.full_like(planes, np.nan), p)
    return found[:, lane]


class Flock(NamedTuple):
    """What FL-ORCA says about one world: preferred velocity `[num_robots, 2]` and a robot's notes."""

    velocity: np.ndarray
    states: np.ndarray
    flags: np.ndarray
    leaders: np.ndarray


@kernel
def _flock_rows(num_slots, rows, tile, rng, pref_x, pref_y, p):
    for row in range(rows):
        find_neighbours(row, 0, num_slots, num_slots, tile, p.near)
    find_flock_terms(0, rows, tile, rng, p)
    for row in range(rows):
        x, y = preferred_velocity(row, tile, p.flock)
        store(pref_x, row, x)
        store(pref_y, row, y)


def flock_of(pos, vel, goals, seed, p, real=np.float32):
    """Flock of one world; `p` are its SwarmParams."""
    pos = np.asarray(pos, real)
    n = len(pos)
    tile, rows = _world_tile(pos, np.zeros_like(pos) if vel is None else vel, p.near.capacity, 0, -1, real)
    tile.reach_sq[:] = p.near.range_sq
    tile.group[:n] = np.arange(n) // (p.num_robots // p.groups)
    tile.aim[:n, :2] = np.asarray(goals, real)[tile.group[:n]] - pos
    tile.aim[:n, 2] = tile.aim[:n, 0] * tile.aim[:n, 0] + tile.aim[:n, 1] * tile.aim[:n, 1]
    pref = np.zeros((2, rows * LANES), real)
    _flock_rows(n, rows, tile, np.array([seed], np.uint64), *pref, p)
    return Flock(pref[:, :n].T.copy(), tile.machine[:n], tile.flags[:n], tile.leaders[:n])


@kernel
def _terms(tile, gain, f):
    apart = look(0, 0, tile, f)
    finish_separation(0, tile, apart, splat(gain), f)


def terms_of_robot_0(pos, vel, goal, gain, f, robots, real=np.float32):
    """(cohesion, separation, alignment) `[3, 2]` of robot 0, all others being its neighbours."""
    n = len(pos)
    tile = empty_tile(max(n, LANES), 1, n - 1, real)
    tile.order[0, 1:] = len(tile.body) - 1  # nobody
    tile.body[:n, :2], tile.body[:n, 2:] = pos, vel
    tile.aim[0] = *goal, np.dot(goal, goal), 0
    tile.group[:n] = np.arange(n) // robots
    tile.neighbours[:] = -1
    tile.neighbours[0, 0, :, 0] = np.arange(1, n)
    tile.counts[0] = n - 1
    _terms(tile, real(gain), f)
    return tile.terms[0, :, 0].reshape(3, 2)


@kernel
def _sum(state, sees, values, out, f):
    terms = (load(values, 0), load(values, 1), load(values, 2), load(values, 3), load(values, 4), load(values, 5))
    goal_x, goal_y, leader_x, leader_y = load(values, 6), load(values, 7), load(values, 8), load(values, 9)
    x, y = weighted_sum(load(state, 0), load(sees, 0) != 0, terms, goal_x, goal_y, leader_x, leader_y, f)
    store(out, 0, x)
    store(out, 1, y)


def weighted_sum_of(state, sees, terms, goal, leader, f, lane=2):
    """The weighted sum `[2]` of one robot in `state`; the other lanes hold other states and values."""
    states = ((np.arange(LANES) - lane + state) % 4).astype(np.int32)
    seeing = ((np.arange(LANES) - lane + sees) % 2).astype(np.int32)
    values = np.random.default_rng(0).normal(size=(10, LANES)).astype(np.float32)
    values[:, lane] = [*terms, *goal, *leader]
    out = np.zeros((2, LANES), np.float32)
    _sum(states, seeing, values, out, f)
    return out[:, lane]
