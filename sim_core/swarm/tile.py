"""Tiles: the work space in which a few worlds take their step.

The worlds of a batch are processed in tiles (loop tiling). The robots of a tile's worlds stand side by side, so that
vectors of eight are full: a world of 10 robots would leave 6 of 16 lanes idle, four such worlds fill five vectors. A
tile holds the fewest worlds that fill its vectors (one if their size is a multiple of eight), and is small enough to
stay in the processor's cache over all passes of a step.

A slot is a robot's index in the tile. A row is a vector of eight slots, which the passes process together.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from sim_core.config import WorldConfig
from sim_core.lanes import LANES
from sim_core.swarm.grid import Grid, empty_grid


class Tile(NamedTuple):
    """Work space of a tile; `k` is `max_neighbours`, reals are of the worlds' dtype.

    The last slot is padding. Its position is NaN, so that every comparison with it is false.

    pos_vel: `[slots, 4]`, position (metres) and velocity (m/s) in the old state.
    to_goal: `[slots, 4]`, vector to the goal (metres), its squared length, 0.
    group: `[slots]` int32.
    search_radius_sq: `[tiles, slots]`, squared radius in which the grid's search for neighbours begins.
    candidate_x, candidate_y: `[slots]`, positions of the candidates, in search order; x is NaN for a hidden robot.
    candidate_slot: `[slots]` int32, the candidates' slots.
    row_slots: `[rows, 8]` int32, the slots in each row's lanes.
    neighbours: `[tiles, rows, k, 8]` int32 slots, nearest first, -1 for none; with a grid, one tile's.
    flockmates: `[rows, k, 8]` int32, the neighbours of the robot's own group; elsewhere the robot itself.
    neighbour_counts: `[rows]` int32, entries of the longest neighbour list of the row.
    distances_sq: `[k, 8]`, squared metres.
    flock_terms: `[rows, 6, 8]`, x and y of cohesion, separation and alignment.
    flags: `[slots]` int32, bits of `flock_rules`.
    leaders: `[slots]` int32, the slot of the robot that is followed, -1 for none.
    lines, projected: `[k, 4, 8]`, scratch of the linear programs.
    new_vx, new_vy: `[slots]`, m/s.
    is_given: `[slots]` int32, 1 where FL-ORCA's velocity is not needed, 0 elsewhere; used where several robots learn.
    machine: `[slots]` int32, the state of FL-ORCA's state machine.
    noise: `[8]`, one draw per lane.
    grid: Grid, used in large worlds.
    """

    pos_vel: Any
    to_goal: Any
    group: Any
    search_radius_sq: Any
    candidate_x: Any
    candidate_y: Any
    candidate_slot: Any
    row_slots: Any
    neighbours: Any
    flockmates: Any
    neighbour_counts: Any
    distances_sq: Any
    flock_terms: Any
    flags: Any
    leaders: Any
    lines: Any
    projected: Any
    new_vx: Any
    new_vy: Any
    is_given: Any
    machine: Any
    noise: Any
    grid: Grid


GRID_FROM_ROBOTS = 300
"""Worlds with at least as many robots use the grid to find neighbours; smaller ones test all pairs, which is faster."""


def worlds_per_tile(num_robots: int) -> int:
    """The fewest worlds of `num_robots` that fill vectors of eight; one if they use the grid."""
    return 1 if num_robots >= GRID_FROM_ROBOTS else LANES // math.gcd(num_robots, LANES)


def world_tile(config: WorldConfig, num_worlds: int, dtype: Any) -> Tile:
    """The work space for a batch of `num_worlds` worlds of `config`."""
    num_robots = config.num_robots
    if num_robots >= GRID_FROM_ROBOTS:  # in the worst case every row ends after one robot
        return empty_tile(num_robots, num_robots, config.max_neighbours, dtype, num_tiles=num_worlds, use_grid=True)
    worlds = min(worlds_per_tile(num_robots), num_worlds)
    rows = -(-worlds * num_robots // LANES)
    return empty_tile(rows * LANES, rows, config.max_neighbours, dtype, num_tiles=-(-num_worlds // worlds))


def empty_tile(
    num_slots: int, num_rows: int, max_neighbours: int, dtype: Any, *, num_tiles: int = 1, use_grid: bool = False
) -> Tile:
    """The work space for `num_slots` robots in `num_rows` rows.

    Args:
      num_slots: robots of a tile, without the padding slot.
      num_rows: rows of a tile.
      max_neighbours: length of a neighbour list.
      dtype: of the real numbers.
      num_tiles: tiles of the batch; each has its own neighbour lists or search radii, which the next step reuses.
      use_grid: whether neighbours are found with the grid.
    """
    slots, k = num_slots + 1, max_neighbours

    def int32_zeros(*shape: int) -> Any:
        return np.zeros(shape, np.int32)

    tile = Tile(
        pos_vel=np.full((slots, 4), np.nan, dtype),
        to_goal=np.full((slots, 4), np.nan, dtype),
        group=int32_zeros(slots),
        search_radius_sq=np.zeros((num_tiles, slots), dtype),
        candidate_x=np.zeros(slots, dtype),
        candidate_y=np.zeros(slots, dtype),
        candidate_slot=np.arange(slots, dtype=np.int32),
        row_slots=np.arange(num_rows * LANES, dtype=np.int32).reshape(num_rows, LANES),
        neighbours=np.full((1 if use_grid else num_tiles, num_rows, k, LANES), -1, np.int32),
        flockmates=int32_zeros(num_rows, k, LANES),
        neighbour_counts=int32_zeros(num_rows),
        distances_sq=np.zeros((k, LANES), dtype),
        flock_terms=np.zeros((num_rows, 6, LANES), dtype),
        flags=int32_zeros(slots),
        leaders=int32_zeros(slots),
        lines=np.zeros((k, 4, LANES), dtype),
        projected=np.zeros((k, 4, LANES), dtype),
        new_vx=np.zeros(slots, dtype),
        new_vy=np.zeros(slots, dtype),
        is_given=int32_zeros(slots),
        machine=int32_zeros(slots),
        noise=np.zeros(LANES, dtype),
        grid=empty_grid(num_slots),
    )
    np.minimum(tile.row_slots, num_slots, out=tile.row_slots)
    return tile
