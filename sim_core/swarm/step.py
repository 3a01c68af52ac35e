"""One step of the swarm in every world: all robots read the old state, then all move.

The learning robot takes the velocity it is given, or, without a pilot, FL-ORCA's like everybody else.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sim_core.config import WorldConfig
from sim_core.jit import inlined, kernel
from sim_core.lanes import LANES, any_lane, load, scatter, splat
from sim_core.orca import ORCAParams, build_half_planes, orca_params, orca_velocity
from sim_core.rng import skip, uniform_after
from sim_core.swarm.flock_rules import (
    FOLLOWS_FOLLOWER,
    FOLLOWS_FREE,
    FREE,
    NO_FLOCK,
    PUBLISHED,
    FlockParams,
    flock_params,
)
from sim_core.swarm.flocking import clear_leaders, finish_separation, look, mark_followers, preferred_velocity
from sim_core.swarm.grid import CELLS_PER_RANGE, arrange
from sim_core.swarm.neighbours import NeighbourParams, find_neighbours, lists_of, neighbour_params
from sim_core.swarm.tile import GRID_FROM_ROBOTS, worlds_per_tile


class SwarmParams(NamedTuple):
    """Constants of the swarm's step in the worlds' dtype."""

    orca: ORCAParams
    flock: FlockParams
    near: NeighbourParams
    time_step_s: Any
    nowhere: Any
    cell_edge_m: float
    knows_learner: bool
    num_robots: int
    groups: int
    tile_worlds: int


def swarm_params(config: WorldConfig, dtype: Any) -> SwarmParams:
    """The swarm's constants of `config`."""
    real = np.dtype(dtype).type
    drift_m = 2.0 * config.time_step_s * config.top_speed_m_s
    return SwarmParams(
        orca=orca_params(config.orca_radius_m, config.orca_horizon_s, config.time_step_s, config.max_speed_m_s, dtype),
        flock=flock_params(config, dtype),
        near=neighbour_params(
            config.max_neighbours, config.neighbour_range_m, drift_m, dtype, grid=config.num_robots >= GRID_FROM_ROBOTS
        ),
        time_step_s=real(config.time_step_s),
        nowhere=real(np.nan),
        cell_edge_m=config.neighbour_range_m / CELLS_PER_RANGE,
        knows_learner=config.learner_is_known,
        num_robots=config.num_robots,
        groups=config.groups,
        tile_worlds=worlds_per_tile(config.num_robots),
    )


@inlined
def _load_world(world, base, state, tile, p):
    """Copies one world's old state into the tile, from slot `base` on."""
    for group in range(p.groups):
        goal_x, goal_y = state.goal_x[world, group], state.goal_y[world, group]
        for i in range(state.group_begin[group], state.group_begin[group + 1]):
            slot = base + i
            x, y = state.pos_x[world, i], state.pos_y[world, i]
            to_x, to_y = goal_x - x, goal_y - y
            tile.body[slot, 0], tile.body[slot, 1] = x, y
            tile.body[slot, 2], tile.body[slot, 3] = state.vel_x[world, i], state.vel_y[world, i]
            tile.aim[slot, 0], tile.aim[slot, 1], tile.aim[slot, 2] = to_x, to_y, to_x * to_x + to_y * to_y
            tile.group[slot] = group
            if not p.near.grid:
                tile.seen_x[slot], tile.seen_y[slot] = x, y


@inlined
def load_tile(first, worlds, state, tile, p):
    """Copies the old state of `worlds` worlds into the tile and arranges the candidates; returns the rows."""
    size = p.num_robots
    for i in range(worlds):
        _load_world(first + i, i * size, state, tile, p)
    if p.near.grid:
        rows = arrange(size, tile, p.cell_edge_m)
    else:
        rows = (worlds * size + LANES - 1) // LANES
        for slot in range(worlds * size, rows * LANES):
            tile.body[slot, 0] = p.nowhere
    if not p.knows_learner:
        for i in range(worlds):
            learner = i * size + state.learner[first + i]
            tile.seen_x[tile.grid.place[learner] if p.near.grid else learner] = p.nowhere
    return rows


@inlined
def _separation_gain(row, tile_index, apart, tile, rng, p):
    """Gain of the published separation (a vector): 1 and a random part, one draw a robot."""
    if not (p.flock.rules == PUBLISHED and p.flock.separation_noise > p.flock.zero and any_lane(apart > p.flock.zero)):
        return splat(p.flock.one)
    size = p.num_robots
    for lane in range(LANES):
        slot = tile.order[row, lane]
        world = min(tile_index * p.tile_worlds + slot // size, rng.shape[0] - 1)
        tile.noise[lane] = uniform_after(rng[world], slot % size + 1)
    return p.flock.one + p.flock.separation_noise * load(tile.noise, 0)


@inlined
def find_flock_terms(tile_index, rows, tile, rng, p):
    """All passes before the preferred velocities."""
    for row in range(rows):
        apart = look(row, lists_of(row, tile_index, tile, p.near), tile, p.flock)
        finish_separation(row, tile, apart, _separation_gain(row, tile_index, apart, tile, rng, p), p.flock)
        clear_leaders(row, tile)
    for row in range(rows):
        mark_followers(row, FREE, FOLLOWS_FREE, tile)
    for row in range(rows):
        mark_followers(row, FOLLOWS_FREE, FOLLOWS_FOLLOWER, tile)


@inlined
def tile_velocities(tile_index, num_slots, rows, tile, rng, p):
    """FL-ORCA's new velocities of all robots of a tile, into `tile.new_vx`, `tile.new_vy`."""
    size = p.num_robots
    for row in range(rows):
        find_neighbours(row, tile_index, size, num_slots, tile, p.near)
    if p.flock.rules != NO_FLOCK:
        find_flock_terms(tile_index, rows, tile, rng, p)
    for row in range(rows):
        robot, count, at = load(tile.order, row), tile.counts[row], lists_of(row, tile_index, tile, p.near)
        pref_x, pref_y = preferred_velocity(row, tile, p.flock)
        build_half_planes(robot, tile.body, tile.neighbours, at, count, tile.lines, p.orca)
        x, y = orca_velocity(tile.lines, count, pref_x, pref_y, tile.projected, p.orca)
        scatter(tile.new_vx, robot, x)
        scatter(tile.new_vy, robot, y)


@inlined
def move_world(world, base, state, tile, command_x, command_y, piloted, p):
    """Moves one world's robots with the tile's new velocities."""
    if piloted:
        tile.new_vx[base + state.learner[world]] = command_x[world]
        tile.new_vy[base + state.learner[world]] = command_y[world]
    for i in range(state.pos_x.shape[1]):
        vx, vy = tile.new_vx[base + i], tile.new_vy[base + i]
        state.vel_x[world, i], state.vel_y[world, i] = vx, vy
        state.pos_x[world, i] += vx * p.time_step_s
        state.pos_y[world, i] += vy * p.time_step_s
        state.machine[world, i] = tile.machine[base + i]
    state.steps[world] += 1
    if p.flock.rules == PUBLISHED and p.flock.separation_noise > p.flock.zero:
        skip(state.rng, world, state.pos_x.shape[1])


@kernel
def advance(state, tile, command_x, command_y, piloted, params):
    """Moves every world by one step.

    Args:
      state: WorldState, changed in place.
      tile: Tile.
      command_x, command_y: `[num_worlds]`, the learning robot's velocity, m/s.
      piloted: whether the learning robot obeys the command; else FL-ORCA drives it too.
      params: SwarmParams, packed.
    """
    p = params[0]
    num_worlds, size = state.pos_x.shape
    for first in range(0, num_worlds, p.tile_worlds):
        worlds = min(p.tile_worlds, num_worlds - first)
        rows = load_tile(first, worlds, state, tile, p)
        tile_velocities(first // p.tile_worlds, worlds * size, rows, tile, state.rng, p)
        for i in range(worlds):
            move_world(first + i, i * size, state, tile, command_x, command_y, piloted, p)


@kernel
def reset_episode(state, mask):
    """Resets the counters of an episode that a scene has just placed, where `mask` `[num_worlds]` bool is set."""
    for world in range(mask.shape[0]):
        if not mask[world]:
            continue
        state.steps[world] = 0
        state.outside_steps[world] = 0
        state.episode_return[world] = 0.0
        learner = state.learner[world]
        group = state.group[learner]
        dx = state.pos_x[world, learner] - state.goal_x[world, group]
        dy = state.pos_y[world, learner] - state.goal_y[world, group]
        state.goal_distance_m[world] = np.sqrt(dx * dx + dy * dy)
        for i in range(state.pos_x.shape[1]):
            state.machine[world, i] = 0
