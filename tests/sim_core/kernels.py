"""Wrappers through which tests call the kernels, whose vectors of eight Python cannot hold.

A single problem goes into one lane. The other lanes hold decoys, so that a kernel which mixes lanes fails.
"""

from typing import NamedTuple

import numpy as np

from sim_core.jit import kernel
from sim_core.lanes import LANES, gather, load, scatter, splat, store
from sim_core.orca import build_half_planes, linear_program_2, linear_program_3, orca_params, orca_velocity
from sim_core.swarm.flocking import finish_separation, preferred_velocity, sense_neighbours, weighted_sum
from sim_core.swarm.grid import CELLS_PER_RANGE, build_cell_list
from sim_core.swarm.neighbours import find_neighbours, neighbour_params
from sim_core.swarm.step import run_flocking_passes
from sim_core.swarm.tile import empty_tile


class OrcaStep(NamedTuple):
    """ORCA's new velocities `[n, 2]`; of each robot its half-planes `[count, 4]` and neighbours `[count]`."""

    velocity: np.ndarray
    planes: list[np.ndarray]
    neighbours: list[np.ndarray]


@kernel
def _orca_rows(num_slots, rows, tile, pref_x, pref_y, planes, search, orca):
    for row in range(rows):
        find_neighbours(row, 0, num_slots, num_slots, tile, search)
    for row in range(rows):
        robot, count = load(tile.row_slots, row), tile.neighbour_counts[row]
        row_pref_x, row_pref_y = gather(pref_x, robot), gather(pref_y, robot)
        build_half_planes(robot, tile.pos_vel, tile.neighbours, row * search.max_neighbours, count, tile.lines, orca)
        x, y = orca_velocity(tile.lines, count, row_pref_x, row_pref_y, tile.projected, orca)
        scatter(tile.new_vx, robot, x)
        scatter(tile.new_vy, robot, y)
        for i in range(4 * count):
            store(planes, 4 * search.max_neighbours * row + i, load(tile.lines, i))


@kernel
def _build_cell_list(num_slots, tile, cell_size_m):
    return build_cell_list(num_slots, tile, cell_size_m)


def cell_list(pos, cell_size_m, real=np.float32):
    """(tile, rows) of one world's robots, sorted into a grid with cells of `cell_size_m` or larger.

    All arrays that `build_cell_list` has to write hold invalid numbers before.
    """
    n = len(pos)
    tile = empty_tile(n, n, 1, real)
    tile.pos_vel[:n, :2] = pos
    for array in (tile.row_slots, tile.candidate_slot, *tile.grid):
        array[:] = -99
    return tile, _build_cell_list(n, tile, float(cell_size_m))


def _world_tile(pos, vel, max_neighbours, search_radius_m, hidden, real, cell_size_m=None):
    """(tile, rows) of one world's robots; with a grid if `cell_size_m` is given."""
    n = len(pos)
    rows = -(-n // LANES)
    tile = empty_tile(*((rows * LANES, rows) if cell_size_m is None else (n, n)), max_neighbours, real)
    tile.pos_vel[:n, :2], tile.pos_vel[:n, 2:] = pos, vel
    tile.candidate_x[:n], tile.candidate_y[:n] = np.transpose(pos)
    tile.search_radius_sq[:] = real(search_radius_m) ** 2
    if cell_size_m is not None:
        rows = _build_cell_list(n, tile, cell_size_m)
    if hidden >= 0:
        tile.candidate_x[hidden if cell_size_m is None else tile.grid.rank[hidden]] = np.nan
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
    search_radius_m=None,
    use_grid=False,
    last_lists=None,
):
    """One step of ORCA for one world's robots, computed in `real`.

    Args:
      pos, vel, pref: `[n, 2]`, positions (m), velocities and preferred velocities (m/s).
      real: np.float32 or np.float64.
      hidden: a robot that is nobody's neighbour, or -1.
      search_radius_m: radius in which the grid's search begins, the whole range by default.
      use_grid: whether neighbours are found with the grid, as in large worlds.
      last_lists: `[n, max_neighbours]`, the robots' neighbour lists of the last step, -1 for none; empty by default.
    """
    pos, vel, pref = (np.asarray(array, real) for array in (pos, vel, pref))
    n = len(pos)
    cell_size_m = range_m / CELLS_PER_RANGE if use_grid else None
    search_radius_m = range_m if search_radius_m is None else search_radius_m
    tile, rows = _world_tile(pos, vel, max_neighbours, search_radius_m, hidden, real, cell_size_m)
    if last_lists is not None:
        lists = np.full((rows * LANES, max_neighbours), -1)
        lists[:n] = last_lists
        tile.neighbours[0] = lists.reshape(rows, LANES, max_neighbours).transpose(0, 2, 1)
    padded = np.zeros((2, len(tile.pos_vel)), real)
    padded[:, :n] = pref.T
    planes = np.zeros((rows, max_neighbours, 4, LANES), real)
    search = neighbour_params(max_neighbours, range_m, 0.1, real, use_grid=use_grid)
    orca = orca_params(radius_m, horizon_s, time_step_s, max_speed_m_s, real)
    _orca_rows(n, rows, tile, *padded, planes, search, orca)
    lane_of = np.argsort(tile.row_slots[:rows].ravel(), kind="stable")[:n]  # the robots come before the padding
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
    """`[..., 8]`: the problem in its lane, rotated copies of it in the others."""
    problem = np.asarray(problem, np.float64)
    points = problem.reshape(*problem.shape[:-1], -1, 2)
    angle = 0.7 * (np.arange(LANES) - lane)
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = points[..., 0, None], points[..., 1, None]
    rotated = np.stack([x * cos - y * sin, x * sin + y * cos], axis=-2)
    return np.ascontiguousarray(rotated.reshape(*problem.shape, LANES))


@kernel
def _second_program(lines, opt, direction_opt, failed, velocity, p):
    num_lines = lines.shape[0]
    line, x, y = linear_program_2(lines, num_lines, load(opt, 0), load(opt, 1), splat(True), direction_opt, p)
    store(failed, 0, line)
    store(velocity, 0, x)
    store(velocity, 1, y)


@kernel
def _third_program(lines, failed, velocity, projected, p):
    line, x, y = load(failed, 0), load(velocity, 0), load(velocity, 1)
    x, y = linear_program_3(lines, lines.shape[0], line, x, y, projected, p)
    store(velocity, 0, x)
    store(velocity, 1, y)


def second_program(lines, opt, direction_opt, p, lane=3):
    """(failed line, velocity `[2]`) of one problem with half-planes `[num_lines, 4]`, float64."""
    failed, velocity = np.zeros(LANES, np.int32), np.zeros((2, LANES))
    _second_program(_in_lane(lines, lane), _in_lane(opt, lane), direction_opt, failed, velocity, p)
    return int(failed[lane]), velocity[:, lane]


def third_program(lines, failed_line, velocity, p, lane=5):
    """Velocity `[2]` of the third program after the second one failed at `failed_line` with `velocity`."""
    failed, velocities = np.full(LANES, failed_line, np.int32), _in_lane(velocity, lane)
    planes = _in_lane(lines, lane)
    _third_program(planes, failed, velocities, np.full_like(planes, np.nan), p)
    return velocities[:, lane]


class Flock(NamedTuple):
    """FL-ORCA's results for one world: preferred velocities `[num_robots, 2]`; `[num_robots]` int32 the others."""

    velocity: np.ndarray
    states: np.ndarray
    flags: np.ndarray
    leaders: np.ndarray


@kernel
def _flock_rows(num_slots, rows, tile, rng, pref_x, pref_y, p):
    for row in range(rows):
        find_neighbours(row, 0, num_slots, num_slots, tile, p.neighbours)
    run_flocking_passes(0, rows, tile, rng, p)
    for row in range(rows):
        x, y = preferred_velocity(row, tile, p.flock)
        store(pref_x, row, x)
        store(pref_y, row, y)


def flock_of(pos, vel, goals, seed, p, real=np.float32):
    """The Flock of one world. `p`: its SwarmParams."""
    pos = np.asarray(pos, real)
    n = len(pos)
    vel = np.zeros_like(pos) if vel is None else vel
    tile, rows = _world_tile(pos, vel, p.neighbours.max_neighbours, 0, -1, real)
    tile.search_radius_sq[:] = p.neighbours.range_sq
    tile.group[:n] = np.arange(n) // (p.num_robots // p.groups)
    to_goal = tile.to_goal[:n]
    to_goal[:, :2] = np.asarray(goals, real)[tile.group[:n]] - pos
    to_goal[:, 2] = to_goal[:, 0] * to_goal[:, 0] + to_goal[:, 1] * to_goal[:, 1]
    pref = np.zeros((2, rows * LANES), real)
    _flock_rows(n, rows, tile, np.array([seed], np.uint64), *pref, p)
    return Flock(pref[:, :n].T.copy(), tile.machine[:n], tile.flags[:n], tile.leaders[:n])


@kernel
def _terms(tile, gain, f):
    num_separated = sense_neighbours(0, 0, tile, f)
    finish_separation(0, tile, num_separated, splat(gain), f)


def terms_of_robot_0(pos, vel, goal, gain, f, robots, real=np.float32):
    """(cohesion, separation, alignment) `[3, 2]` of robot 0; all others are its neighbours."""
    n = len(pos)
    tile = empty_tile(max(n, LANES), 1, n - 1, real)
    tile.row_slots[0, 1:] = len(tile.pos_vel) - 1  # the padding slot
    tile.pos_vel[:n, :2], tile.pos_vel[:n, 2:] = pos, vel
    tile.to_goal[0] = *goal, np.dot(goal, goal), 0
    tile.group[:n] = np.arange(n) // robots
    tile.neighbours[:] = -1
    tile.neighbours[0, 0, :, 0] = np.arange(1, n)
    tile.neighbour_counts[0] = n - 1
    _terms(tile, real(gain), f)
    return tile.flock_terms[0, :, 0].reshape(3, 2)


@kernel
def _sum(state, sees, values, out, f):
    terms = (load(values, 0), load(values, 1), load(values, 2), load(values, 3), load(values, 4), load(values, 5))
    goal_x, goal_y, leader_x, leader_y = load(values, 6), load(values, 7), load(values, 8), load(values, 9)
    x, y = weighted_sum(load(state, 0), load(sees, 0) != 0, terms, goal_x, goal_y, leader_x, leader_y, f)
    store(out, 0, x)
    store(out, 1, y)


def weighted_sum_of(state, sees, terms, goal, leader, f, lane=2):
    """The weighted sum `[2]` of one robot in `state`; the other lanes hold other states and numbers."""
    states = ((np.arange(LANES) - lane + state) % 4).astype(np.int32)
    sees_all = ((np.arange(LANES) - lane + sees) % 2).astype(np.int32)
    values = np.random.default_rng(0).normal(size=(10, LANES)).astype(np.float32)
    values[:, lane] = [*terms, *goal, *leader]
    out = np.zeros((2, LANES), np.float32)
    _sum(states, sees_all, values, out, f)
    return out[:, lane]
