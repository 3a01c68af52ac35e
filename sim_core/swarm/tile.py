"""A tile: the robots of a few worlds side by side, so that vectors of eight are full, and their work space.

Worlds of 10 robots would leave 6 of 16 lanes idle; four of them are five full vectors. A tile holds as many
worlds as it takes (one, where their size is a multiple of eight), small enough to stay in the cache over all
passes of a step. A slot is a robot's place in the tile; a row is a vector of eight slots.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from sim_core.config import WorldConfig
from sim_core.lanes import LANES
from sim_core.swarm.grid import Grid, empty_grid


class Tile(NamedTuple):
    """Work space of a tile. The last slot is nobody's: NaN, so that every comparison with it is false.

    body: `[slots, 4]` position (metres) and velocity (m/s) in the old state.
    aim: `[slots, 4]` vector to the goal (metres), its squared length, 0.
    group: `[slots]` int32.
    reach_sq: `[tiles, slots]`, by grid: radius within which the search for neighbours begins, squared.
    seen_x, seen_y: `[slots]`, positions of candidates in search order; NaN where nobody may see it.
    seen_slot: `[slots]` int32, their slots.
    order: `[rows, 8]` int32, slots of the rows' lanes.
    neighbours: `[tiles, rows, max_neighbours, 8]` int32 slots, nearest first, -1 for none; by grid, one tile's.
    mates: `[rows, max_neighbours, 8]`, the same, the robot itself in the place of one of another group or none.
    counts: `[rows]` int32, entries of the row's longest list.
    distances: `[max_neighbours, 8]`, squared metres.
    terms: `[rows, 6, 8]`, cohesion, separation and alignment.
    flags, leaders: `[slots]` int32.
    lines, projected: `[max_neighbours, 4, 8]`.
    new_vx, new_vy: `[slots]`, m/s.
    machine: `[slots]` int32.
    noise: `[8]`.
    grid: Grid, used in large worlds.
    """

    body: Any
    aim: Any
    group: Any
    reach_sq: Any
    seen_x: Any
    seen_y: Any
    seen_slot: Any
    order: Any
    neighbours: Any
    mates: Any
    counts: Any
    distances: Any
    terms: Any
    flags: Any
    leaders: Any
    lines: Any
    projected: Any
    new_vx: Any
    new_vy: Any
    machine: Any
    noise: Any
    grid: Grid


GRID_FROM_ROBOTS = 300
"""Worlds with at least as many robots are searched by grid; smaller ones robot by robot, which is faster there."""


def worlds_per_tile(num_robots: int) -> int:
    """Fewest worlds of `num_robots` that fill vectors of eight; one if they are searched by grid."""
    return 1 if num_robots >= GRID_FROM_ROBOTS else LANES // math.gcd(num_robots, LANES)


def world_tile(config: WorldConfig, num_worlds: int, dtype: Any) -> Tile:
    """Work space for a batch of `num_worlds` worlds of `config`."""
    size = config.num_robots
    if size >= GRID_FROM_ROBOTS:  # a row may be cut after any robot
        return empty_tile(size, size, config.max_neighbours, dtype, num_tiles=num_worlds, grid=True)
    worlds = min(worlds_per_tile(size), num_worlds)
    rows = -(-worlds * size // LANES)
    return empty_tile(rows * LANES, rows, config.max_neighbours, dtype, num_tiles=-(-num_worlds // worlds))


def empty_tile(
    num_slots: int, num_rows: int, max_neighbours: int, dtype: Any, *, num_tiles: int = 1, grid: bool = False
) -> Tile:
    """Work space for `num_slots` robots in `num_rows` rows, and what it remembers of `num_tiles` tiles."""
    slots, k = num_slots + 1, max_neighbours

    def whole(*shape: int) -> Any:
        return np.zeros(shape, np.int32)

    tile = Tile(
        body=np.full((slots, 4), np.nan, dtype),
        aim=np.full((slots, 4), np.nan, dtype),
        group=whole(slots),
        reach_sq=np.zeros((num_tiles, slots), dtype),
        seen_x=np.zeros(slots, dtype),
        seen_y=np.zeros(slots, dtype),
        seen_slot=np.arange(slots, dtype=np.int32),
        order=np.arange(num_rows * LANES, dtype=np.int32).reshape(num_rows, LANES),
        neighbours=np.full((1 if grid else num_tiles, num_rows, k, LANES), -1, np.int32),
        mates=whole(num_rows, k, LANES),
        counts=whole(num_rows),
        distances=np.zeros((k, LANES), dtype),
        terms=np.zeros((num_rows, 6, LANES), dtype),
        flags=whole(slots),
        leaders=whole(slots),
        lines=np.zeros((k, 4, LANES), dtype),
        projected=np.zeros((k, 4, LANES), dtype),
        new_vx=np.zeros(slots, dtype),
        new_vy=np.zeros(slots, dtype),
        machine=whole(slots),
        noise=np.zeros(LANES, dtype),
        grid=empty_grid(num_slots),
    )
    np.minimum(tile.order, num_slots, out=tile.order)
    return tile
