"""One step of the swarm in every world: all robots read the old state, then all move.

Learning robots move with the velocities that they are given. Without a command FL-ORCA drives them like every other
robot, and it always drives those whose episode has ended.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sim_core.config import WorldConfig
from sim_core.jit import inlined, kernel
from sim_core.lanes import LANES, any_lane, gather, load, scatter, splat
from sim_core.orca import ORCAParams, build_half_planes, orca_params, orca_velocity
from sim_core.rng import skip_ahead, uniform_at
from sim_core.state import learners_per_world
from sim_core.swarm.flock_rules import (
    FOLLOWER_LEVEL_1,
    FOLLOWER_LEVEL_2,
    NO_FLOCK,
    PUBLISHED,
    VIEW_FREE,
    FlockParams,
    flock_params,
)
from sim_core.swarm.flocking import (
    clear_leaders,
    finish_separation,
    mark_followers,
    preferred_velocity,
    sense_neighbours,
)
from sim_core.swarm.grid import CELLS_PER_RANGE, build_cell_list
from sim_core.swarm.neighbours import NeighbourParams, find_neighbours, list_start, neighbour_params
from sim_core.swarm.tile import GRID_FROM_ROBOTS, worlds_per_tile


class SwarmParams(NamedTuple):
    """Constants of the swarm's step; reals are of the worlds' dtype, but for `cell_size_m`."""

    orca: ORCAParams
    flock: FlockParams
    neighbours: NeighbourParams
    time_step_s: Any
    nan: Any
    cell_size_m: float
    knows_learner: bool
    num_robots: int
    groups: int
    worlds_per_tile: int


def swarm_params(config: WorldConfig, dtype: Any) -> SwarmParams:
    """The swarm's constants of `config`."""
    real = np.dtype(dtype).type
    max_approach_m = 2.0 * config.time_step_s * config.top_speed_m_s
    return SwarmParams(
        orca=orca_params(config.orca_radius_m, config.orca_horizon_s, config.time_step_s, config.max_speed_m_s, dtype),
        flock=flock_params(config, dtype),
        neighbours=neighbour_params(
            config.max_neighbours,
            config.neighbour_range_m,
            max_approach_m,
            dtype,
            use_grid=config.num_robots >= GRID_FROM_ROBOTS,
        ),
        time_step_s=real(config.time_step_s),
        nan=real(np.nan),
        cell_size_m=config.neighbour_range_m / CELLS_PER_RANGE,
        knows_learner=config.learner_is_known,
        num_robots=config.num_robots,
        groups=config.groups,
        worlds_per_tile=worlds_per_tile(config.num_robots),
    )


@inlined
def _load_world(world, first_slot, state, tile, p):
    """Copies one world's old state into the tile, from `first_slot` on."""
    for group in range(p.groups):
        goal_x, goal_y = state.goal_x[world, group], state.goal_y[world, group]
        for i in range(state.group_begin[group], state.group_begin[group + 1]):
            slot = first_slot + i
            x, y = state.pos_x[world, i], state.pos_y[world, i]
            to_x, to_y = goal_x - x, goal_y - y
            tile.pos_vel[slot, 0], tile.pos_vel[slot, 1] = x, y
            tile.pos_vel[slot, 2], tile.pos_vel[slot, 3] = state.vel_x[world, i], state.vel_y[world, i]
            tile.to_goal[slot, 0], tile.to_goal[slot, 1], tile.to_goal[slot, 2] = to_x, to_y, to_x * to_x + to_y * to_y
            tile.group[slot] = group
            if not p.neighbours.use_grid:
                tile.candidate_x[slot], tile.candidate_y[slot] = x, y


@inlined
def load_tile(first_world, num_worlds, state, running, tile, p):
    """Copies the old state of `num_worlds` worlds into the tile and arranges the candidates of the neighbour search.

    A running learning robot that the swarm does not know is hidden: it is nobody's neighbour.

    Returns:
      The number of rows.
    """
    num_robots = p.num_robots
    for i in range(num_worlds):
        _load_world(first_world + i, i * num_robots, state, tile, p)
    if p.neighbours.use_grid:
        rows = build_cell_list(num_robots, tile, p.cell_size_m)
    else:
        rows = (num_worlds * num_robots + LANES - 1) // LANES
        for slot in range(num_worlds * num_robots, rows * LANES):
            tile.pos_vel[slot, 0] = p.nan
    if not p.knows_learner:
        per_world = learners_per_world(state)
        for row in range(first_world * per_world, (first_world + num_worlds) * per_world):
            learner = (row // per_world - first_world) * num_robots + state.learner[row]
            if running[row]:
                tile.candidate_x[tile.grid.rank[learner] if p.neighbours.use_grid else learner] = p.nan
    return rows


@inlined
def _separation_gain(row, tile_index, num_separated, tile, rng, p):
    """Vector, gain of the published separation term: 1 + `separation_noise` x U[0, 1).

    Robot i of a world takes draw i + 1 of the world's stream, in whatever order the robots are processed.
    """
    noisy = p.flock.rules == PUBLISHED and p.flock.separation_noise > p.flock.zero
    if not (noisy and any_lane(num_separated > p.flock.zero)):
        return splat(p.flock.one)
    num_robots = p.num_robots
    for lane in range(LANES):
        slot = tile.row_slots[row, lane]
        world = min(tile_index * p.worlds_per_tile + slot // num_robots, rng.shape[0] - 1)
        tile.noise[lane] = uniform_at(rng[world], slot % num_robots + 1)
    return p.flock.one + p.flock.separation_noise * load(tile.noise, 0)


@inlined
def run_flocking_passes(tile_index, rows, tile, rng, p):
    """All passes of flocking before the preferred velocities: flags, terms and leaders."""
    for row in range(rows):
        num_separated = sense_neighbours(row, list_start(row, tile_index, tile, p.neighbours), tile, p.flock)
        gain = _separation_gain(row, tile_index, num_separated, tile, rng, p)
        finish_separation(row, tile, num_separated, gain, p.flock)
        clear_leaders(row, tile)
    for row in range(rows):
        mark_followers(row, VIEW_FREE, FOLLOWER_LEVEL_1, tile)
    if not p.flock.follows_text:
        for row in range(rows):
            mark_followers(row, FOLLOWER_LEVEL_1, FOLLOWER_LEVEL_2, tile)


@inlined
def mark_given(first_world, num_worlds, state, mask, running, tile, p):
    """Writes `tile.is_given`: FL-ORCA moves neither running learning robots with a command nor worlds that stay."""
    per_world, num_robots = learners_per_world(state), p.num_robots
    tile.is_given[:] = 1
    for i in range(num_worlds):
        world = first_world + i
        if not mask[world]:
            continue
        for slot in range(i * num_robots, (i + 1) * num_robots):
            tile.is_given[slot] = 0
        for row in range(world * per_world, (world + 1) * per_world):
            if running[row]:
                tile.is_given[i * num_robots + state.learner[row]] = 1


@inlined
def compute_velocities(tile_index, num_slots, rows, tile, rng, some_given, p):
    """Writes FL-ORCA's new velocities of a tile's robots to `tile.new_vx` and `tile.new_vy`.

    With `some_given`, vectors in which `tile.is_given` is set in all lanes are left out.
    """
    num_robots = p.num_robots
    for row in range(rows):
        find_neighbours(row, tile_index, num_robots, num_slots, tile, p.neighbours)
    if p.flock.rules != NO_FLOCK:
        run_flocking_passes(tile_index, rows, tile, rng, p)
    for row in range(rows):
        robot, count = load(tile.row_slots, row), tile.neighbour_counts[row]
        start = list_start(row, tile_index, tile, p.neighbours)
        pref_x, pref_y = preferred_velocity(row, tile, p.flock)
        if some_given and not any_lane(gather(tile.is_given, robot) == 0):
            continue
        build_half_planes(robot, tile.pos_vel, tile.neighbours, start, count, tile.lines, p.orca)
        x, y = orca_velocity(tile.lines, count, pref_x, pref_y, tile.projected, p.orca)
        scatter(tile.new_vx, robot, x)
        scatter(tile.new_vy, robot, y)


@inlined
def move_world(world, first_slot, state, running, tile, command_x, command_y, use_command, p):
    """Moves one world's robots with the tile's new velocities (explicit Euler), and counts the step."""
    if use_command:
        per_world = learners_per_world(state)
        for row in range(world * per_world, (world + 1) * per_world):
            if running[row]:
                tile.new_vx[first_slot + state.learner[row]] = command_x[row]
                tile.new_vy[first_slot + state.learner[row]] = command_y[row]
    for i in range(state.pos_x.shape[1]):
        vx, vy = tile.new_vx[first_slot + i], tile.new_vy[first_slot + i]
        state.vel_x[world, i], state.vel_y[world, i] = vx, vy
        state.pos_x[world, i] += vx * p.time_step_s
        state.pos_y[world, i] += vy * p.time_step_s
        state.machine[world, i] = tile.machine[first_slot + i]
    state.steps[world] += 1
    if p.flock.rules == PUBLISHED and p.flock.separation_noise > p.flock.zero:
        skip_ahead(state.rng, world, state.pos_x.shape[1])


@kernel
def advance(state, tile, mask, running, command_x, command_y, use_command, params):
    """Advances worlds by one simulator step.

    Args:
      state: WorldState, changed in place.
      tile: Tile.
      mask: `[num_worlds]` bool, the worlds to advance; the others stay as they are.
      running: `[num_rows]` bool, the learning robots whose episode goes on; the others are robots of the swarm.
      command_x, command_y: `[num_rows]`, the learning robots' velocities, m/s.
      use_command: whether running learning robots move with the commands; else FL-ORCA drives them too.
      params: SwarmParams, packed.
    """
    p = params[0]
    num_worlds, num_robots = state.pos_x.shape
    for first_world in range(0, num_worlds, p.worlds_per_tile):
        worlds = min(p.worlds_per_tile, num_worlds - first_world)
        if not mask[first_world : first_world + worlds].any():
            continue
        rows = load_tile(first_world, worlds, state, running, tile, p)
        some_given = use_command and learners_per_world(state) > 1
        if some_given:
            mark_given(first_world, worlds, state, mask, running, tile, p)
        compute_velocities(first_world // p.worlds_per_tile, worlds * num_robots, rows, tile, state.rng, some_given, p)
        for i in range(worlds):
            if mask[first_world + i]:
                world, slot = first_world + i, i * num_robots
                move_world(world, slot, state, running, tile, command_x, command_y, use_command, p)


@kernel
def reset_episode(state, mask):
    """Resets the episode counters of the worlds that a scene has just set up.

    Args:
      state: WorldState, changed in place.
      mask: `[num_worlds]` bool, the worlds to reset.
    """
    for world in range(mask.shape[0]):
        if not mask[world]:
            continue
        state.steps[world] = 0
        per_world = learners_per_world(state)
        for row in range(world * per_world, (world + 1) * per_world):
            state.outside_steps[row] = 0
            state.episode_return[row] = 0.0
            learner = state.learner[row]
            group = state.group[learner]
            dx = state.pos_x[world, learner] - state.goal_x[world, group]
            dy = state.pos_y[world, learner] - state.goal_y[world, group]
            state.goal_distance_m[row] = np.sqrt(dx * dx + dy * dy)
        for i in range(state.pos_x.shape[1]):
            state.machine[world, i] = 0
