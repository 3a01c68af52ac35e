"""A uniform grid over one large world, so that a search looks at nearby robots only and cost grows linearly.

Robots are sorted by cell (a counting sort, anew in every step); the cells of a band of equal y lie side by side, so
that the robots between two columns of a band are one run of candidates. Rows of eight robots are cut
from the same order: the eight are close together and search the same few runs.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sim_core.jit import inlined
from sim_core.lanes import LANES

CELLS_PER_RANGE = 2
"""A cell's edge is the range of the neighbour search divided by this, or larger in a sparse world."""
ROW_SPAN_CELLS = 4
"""A row of eight robots ends before one that is farther from its first than this, along the band."""


class Grid(NamedTuple):
    """Work space of the grid of one world.

    starts: `[max_cells + 1]` int32, first candidate of every cell, band by band.
    cell: `[slots]` int32, each robot's cell.
    place: `[slots]` int32, each robot's place in the search order.
    frame: `[3]` float64, lowest x and y (metres) and cells per metre.
    shape: `[2]` int32, columns and bands.
    """

    starts: Any
    cell: Any
    place: Any
    frame: Any
    shape: Any


def empty_grid(num_slots: int) -> Grid:
    """Work space for `num_slots` robots: four cells a robot."""
    return Grid(
        starts=np.zeros(4 * num_slots + 64, np.int32),
        cell=np.zeros(num_slots, np.int32),
        place=np.zeros(num_slots, np.int32),
        frame=np.zeros(3),
        shape=np.zeros(2, np.int32),
    )


@inlined
def column_of(x, grid):
    """Column of an x, the nearest one if it lies outside."""
    return min(max(int((x - grid.frame[0]) * grid.frame[2]), 0), grid.shape[0] - 1)


@inlined
def band_of(y, grid):
    """Band of a y, the nearest one if it lies outside."""
    return min(max(int((y - grid.frame[1]) * grid.frame[2]), 0), grid.shape[1] - 1)


@inlined
def _lay_out(num_slots, body, grid, edge_m):
    """Chooses the grid's frame: edges of `edge_m`, or longer, so that the cells suffice."""
    low_x, high_x, low_y, high_y = np.float64(0), np.float64(0), np.float64(0), np.float64(0)
    for slot in range(num_slots):
        x, y = np.float64(body[slot, 0]), np.float64(body[slot, 1])
        first = slot == 0
        low_x, high_x = x if first else min(low_x, x), x if first else max(high_x, x)
        low_y, high_y = y if first else min(low_y, y), y if first else max(high_y, y)
    width, height = high_x - low_x, high_y - low_y
    max_cells = grid.starts.shape[0] - 1
    # (w / e + 1) (h / e + 1) <= 2 w h / e^2 + 2 (w + h) / e + 2 cells: both terms are kept below a third
    edge_m = max(edge_m, np.sqrt(6.0 * width * height / max_cells), 6.0 * (width + height) / max_cells)
    grid.frame[0], grid.frame[1], grid.frame[2] = low_x, low_y, 1.0 / edge_m
    grid.shape[0] = min(int(width / edge_m) + 1, max_cells)
    grid.shape[1] = min(int(height / edge_m) + 1, max_cells // grid.shape[0])


@inlined
def _sort(num_slots, tile, grid):
    """Counting sort of the robots by cell, into `grid.place` and the tile's candidates."""
    num_cells = grid.shape[0] * grid.shape[1]
    for cell in range(num_cells + 1):
        grid.starts[cell] = 0
    for slot in range(num_slots):
        cell = band_of(tile.body[slot, 1], grid) * grid.shape[0] + column_of(tile.body[slot, 0], grid)
        grid.cell[slot] = cell
        grid.starts[cell + 1] += 1
    for cell in range(num_cells):
        grid.starts[cell + 1] += grid.starts[cell]
    for slot in range(num_slots):  # `starts` of a cell moves on to its end, which is the next one's start
        place = grid.starts[grid.cell[slot]]
        grid.starts[grid.cell[slot]] = place + 1
        grid.place[slot] = place
        tile.seen_slot[place] = slot
        tile.seen_x[place], tile.seen_y[place] = tile.body[slot, 0], tile.body[slot, 1]
    for cell in range(num_cells, 0, -1):
        grid.starts[cell] = grid.starts[cell - 1]
    grid.starts[0] = 0


@inlined
def _cut_rows(num_slots, tile, grid):
    """Cuts the sorted robots into rows; returns how many."""
    columns = grid.shape[0]
    row, lane = -1, LANES
    band, first = -1, 0
    for place in range(num_slots):
        slot = tile.seen_slot[place]
        cell = grid.cell[slot]
        if lane == LANES or cell // columns != band or cell - first > ROW_SPAN_CELLS:
            for i in range(lane, LANES):
                tile.order[row, i] = num_slots  # nobody
            row, lane = row + 1, 0
            band, first = cell // columns, cell
        tile.order[row, lane] = slot
        lane += 1
    for i in range(lane, LANES):
        tile.order[row, i] = num_slots
    return row + 1


@inlined
def arrange(num_slots, tile, edge_m):
    """Sorts one world's robots into the grid and cuts rows from it.

    Args:
      num_slots: robots of the world.
      tile: Tile with body; seen_x, seen_y, seen_slot, order and grid are written.
      edge_m: smallest edge of a cell, metres.

    Returns:
      Number of rows.
    """
    _lay_out(num_slots, tile.body, tile.grid, edge_m)
    _sort(num_slots, tile, tile.grid)
    return _cut_rows(num_slots, tile, tile.grid)
