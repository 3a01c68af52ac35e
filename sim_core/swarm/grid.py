"""A uniform grid (cell list) over one large world, which makes the cost of the neighbour search linear.

Every step sorts the robots by cell with a counting sort. The cells of a band, i.e. of equal y, are adjacent in that
order, so the robots between two columns of a band form one contiguous run of candidates. Rows of eight robots are cut
from the same order: the eight are close together and scan the same few runs.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sim_core.jit import inlined
from sim_core.lanes import LANES

CELLS_PER_RANGE = 2
"""The cell size is the range of the neighbour search divided by this, or larger in a sparse world."""
ROW_SPAN_CELLS = 4
"""A row of eight robots ends before a robot that is more cells of the band away from the row's first robot."""


class Grid(NamedTuple):
    """Work space of the grid of one world.

    cell_starts: `[max_cells + 1]` int32, index of each cell's first candidate, band by band.
    cell: `[slots]` int32, each robot's cell.
    rank: `[slots]` int32, each robot's index among the candidates, i.e. in the sorted order.
    frame: `[3]` float64, lowest x and y (metres), and cells per metre.
    shape: `[2]` int32, number of columns and of bands.
    """

    cell_starts: Any
    cell: Any
    rank: Any
    frame: Any
    shape: Any


def empty_grid(num_slots: int) -> Grid:
    """Work space for `num_slots` robots: about four cells per robot."""
    return Grid(
        cell_starts=np.zeros(4 * num_slots + 64, np.int32),
        cell=np.zeros(num_slots, np.int32),
        rank=np.zeros(num_slots, np.int32),
        frame=np.zeros(3),
        shape=np.zeros(2, np.int32),
    )


@inlined
def column_of(x, grid):
    """The column of an x (metres); the nearest column if x lies outside the grid."""
    return min(max(int((x - grid.frame[0]) * grid.frame[2]), 0), grid.shape[0] - 1)


@inlined
def band_of(y, grid):
    """The band of a y (metres); the nearest band if y lies outside the grid."""
    return min(max(int((y - grid.frame[1]) * grid.frame[2]), 0), grid.shape[1] - 1)


@inlined
def _fit_frame(num_slots, pos_vel, grid, cell_size_m):
    """Fits the grid to the robots' bounding box; cells are larger than `cell_size_m` if they would not suffice."""
    low_x, high_x, low_y, high_y = np.float64(0), np.float64(0), np.float64(0), np.float64(0)
    for slot in range(num_slots):
        x, y = np.float64(pos_vel[slot, 0]), np.float64(pos_vel[slot, 1])
        first = slot == 0
        low_x, high_x = x if first else min(low_x, x), x if first else max(high_x, x)
        low_y, high_y = y if first else min(low_y, y), y if first else max(high_y, y)
    width, height = high_x - low_x, high_y - low_y
    max_cells = grid.cell_starts.shape[0] - 1
    # Cells of size s: (w / s + 1) (h / s + 1) <= 2 w h / s^2 + 2 (w + h) / s + 2. Either term stays below a third.
    cell_size_m = max(cell_size_m, np.sqrt(6.0 * width * height / max_cells), 6.0 * (width + height) / max_cells)
    grid.frame[0], grid.frame[1], grid.frame[2] = low_x, low_y, 1.0 / cell_size_m
    grid.shape[0] = min(int(width / cell_size_m) + 1, max_cells)
    grid.shape[1] = min(int(height / cell_size_m) + 1, max_cells // grid.shape[0])


@inlined
def _counting_sort(num_slots, tile, grid):
    """Sorts the robots by cell; writes the grid's `cell_starts`, `cell` and `rank`, and the tile's candidates."""
    num_cells = grid.shape[0] * grid.shape[1]
    for cell in range(num_cells + 1):
        grid.cell_starts[cell] = 0
    for slot in range(num_slots):
        cell = band_of(tile.pos_vel[slot, 1], grid) * grid.shape[0] + column_of(tile.pos_vel[slot, 0], grid)
        grid.cell[slot] = cell
        grid.cell_starts[cell + 1] += 1
    for cell in range(num_cells):
        grid.cell_starts[cell + 1] += grid.cell_starts[cell]
    for slot in range(num_slots):  # advances each cell's start to its end, which is the next cell's start
        rank = grid.cell_starts[grid.cell[slot]]
        grid.cell_starts[grid.cell[slot]] = rank + 1
        grid.rank[slot] = rank
        tile.candidate_slot[rank] = slot
        tile.candidate_x[rank], tile.candidate_y[rank] = tile.pos_vel[slot, 0], tile.pos_vel[slot, 1]
    for cell in range(num_cells, 0, -1):
        grid.cell_starts[cell] = grid.cell_starts[cell - 1]
    grid.cell_starts[0] = 0


@inlined
def _cut_rows(num_slots, tile, grid):
    """Cuts the sorted robots into rows of up to eight and pads the rest; returns the number of rows."""
    columns = grid.shape[0]
    row, lane = -1, LANES
    band, first_cell = -1, 0
    for rank in range(num_slots):
        slot = tile.candidate_slot[rank]
        cell = grid.cell[slot]
        if lane == LANES or cell // columns != band or cell - first_cell > ROW_SPAN_CELLS:
            for i in range(lane, LANES):
                tile.row_slots[row, i] = num_slots  # the padding slot
            row, lane = row + 1, 0
            band, first_cell = cell // columns, cell
        tile.row_slots[row, lane] = slot
        lane += 1
    for i in range(lane, LANES):
        tile.row_slots[row, i] = num_slots
    return row + 1


@inlined
def build_cell_list(num_slots, tile, cell_size_m):
    """Sorts one world's robots into the grid's cells and cuts rows from the sorted order.

    Args:
      num_slots: robots of the world.
      tile: Tile with pos_vel; candidate_x, candidate_y, candidate_slot, row_slots and grid are written.
      cell_size_m: smallest edge of a cell, metres.

    Returns:
      The number of rows.
    """
    _fit_frame(num_slots, tile.pos_vel, tile.grid, cell_size_m)
    _counting_sort(num_slots, tile, tile.grid)
    return _cut_rows(num_slots, tile, tile.grid)
