"""The k nearest robots within a range, nearest first, for eight robots at a time.

A scan compares each candidate of a run with eight robots at once. The eight lists of nearest robots are kept sorted, in
`distances_sq` `[max_neighbours, 8]` (squared metres) and `neighbours` `[rows, max_neighbours, 8]` (int32 slots, -1 for
none). Equal distances are ordered by slot, so the lists do not depend on the order of the candidates.

Every search reuses something of the last step. This makes it faster and never changes its result.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from sim_core.jit import inlined
from sim_core.lanes import (
    LANES,
    any_lane,
    extract_lane,
    gather,
    gather_4,
    load,
    maximum,
    minimum,
    scatter,
    select,
    splat,
    sqrt,
    store,
)
from sim_core.swarm.grid import band_of, column_of


class NeighbourParams(NamedTuple):
    """Constants of the search in the worlds' dtype."""

    max_neighbours: int
    use_grid: bool
    range_sq: Any
    below_range_sq: Any
    max_approach_m: Any
    minus_one: Any
    infinity: Any


def neighbour_params(
    max_neighbours: int, range_m: float, max_approach_m: float, dtype: Any, *, use_grid: bool = False
) -> NeighbourParams:
    """The constants of a search.

    Args:
      max_neighbours: length of a neighbour list.
      range_m: range of the search, exclusive.
      max_approach_m: the most that two robots approach each other in a step (the skin of a Verlet list).
      dtype: the worlds' dtype.
      use_grid: whether neighbours are found with the grid.
    """
    real = np.dtype(dtype).type
    return NeighbourParams(
        max_neighbours,
        use_grid,
        real(range_m) ** 2,
        np.nextafter(real(range_m) ** 2, real(0)),
        real(max_approach_m),
        real(-1),
        real(np.inf),
    )


@inlined
def list_start(row, tile_index, tile, p):
    """Where a row's lists start in `tile.neighbours`, in vectors. With a grid all tiles share the same lists."""
    return ((0 if p.use_grid else tile_index) * tile.row_slots.shape[0] + row) * p.max_neighbours


@inlined
def _clear_lists(limit_sq, distances_sq, neighbours, start, max_neighbours):
    """Empties the lists at `start`; only robots nearer than `limit_sq` (vector, m^2, exclusive) will enter them."""
    none = splat(-1)
    for k in range(max_neighbours):
        store(distances_sq, k, limit_sq)
        store(neighbours, start + k, none)


@inlined
def _precedes(dist_sq, slot, entry_sq, entry):
    """Mask of the lanes where a robot belongs before a list's entry: nearer, or equally near and of lower slot."""
    return (dist_sq < entry_sq) | ((dist_sq == entry_sq) & (slot < entry))


@inlined
def _insert(dist_sq, slot, num_entries, distances_sq, neighbours, start):
    """Inserts candidate `slot` into the sorted lists, in the lanes where `dist_sq` is small enough.

    Only the first `num_entries` entries change. The last of them drops out.
    """
    k = num_entries - 1
    here_sq, here = load(distances_sq, k), load(neighbours, start + k)
    precedes = _precedes(dist_sq, slot, here_sq, here)
    while k > 0:
        next_sq, following = load(distances_sq, k - 1), load(neighbours, start + k - 1)
        precedes_next = _precedes(dist_sq, slot, next_sq, following)
        store(distances_sq, k, minimum(here_sq, maximum(next_sq, dist_sq)))
        store(neighbours, start + k, select(precedes_next, following, select(precedes, slot, here)))
        here_sq, here, precedes = next_sq, following, precedes_next
        k -= 1
    store(distances_sq, 0, minimum(dist_sq, here_sq))
    store(neighbours, start, select(precedes, slot, here))


@inlined
def _scan(first, last, robot, active, x, y, tile, start, num_entries, p):
    """Inserts the candidates `first` to `last - 1` that are near enough into the lists at `start`.

    Args:
      first, last: the run of candidates.
      robot: int32 vector, the searching robots; none is its own neighbour.
      active: mask of the robots that search this run.
      x, y: vectors, their positions, metres.
      tile: Tile with candidate_x, candidate_y and candidate_slot, and the lists in distances_sq and neighbours, which
        are cleared or hold what earlier runs found.
      start: vector of `tile.neighbours` where the lists start.
      num_entries: entries that may be in use.
      p: NeighbourParams.

    Returns:
      Entries that may be in use now.
    """
    inactive = splat(p.minus_one)  # no squared distance is that small
    limit_sq = select(active, load(tile.distances_sq, p.max_neighbours - 1), inactive)
    for candidate in range(first, last):
        dx, dy = x - tile.candidate_x[candidate], y - tile.candidate_y[candidate]
        dist_sq = dx * dx + dy * dy
        near = dist_sq <= limit_sq
        if any_lane(near):
            slot = splat(tile.candidate_slot[candidate])
            near = near & (robot != slot)
            if not p.use_grid:  # the lists hold neighbours of the last step, which must not enter twice
                for k in range(num_entries):
                    near = near & (load(tile.neighbours, start + k) != slot)
                if not any_lane(near):
                    continue
            num_entries = min(num_entries + 1, p.max_neighbours)
            dist_sq = select(near, dist_sq, p.infinity)
            _insert(dist_sq, slot, num_entries, tile.distances_sq, tile.neighbours, start)
            limit_sq = select(active, load(tile.distances_sq, p.max_neighbours - 1), inactive)
    return num_entries


@inlined
def _store_search_radius(index, start, tile, p):
    """Stores the radius in which the next step's search begins, for the robots at `index` of `search_radius_sq`.

    The farthest neighbour of a full list, and so each of them, is at most `max_approach_m` farther away a step later.
    A search within that distance fills the list again.
    """
    last = p.max_neighbours - 1
    radius_m = sqrt(load(tile.distances_sq, last)) + p.max_approach_m
    full = load(tile.neighbours, start + last) >= 0
    radius_sq = select(full, minimum(radius_m * radius_m, splat(p.range_sq)), splat(p.range_sq))
    scatter(tile.search_radius_sq, index, radius_sq)


@inlined
def _longest_list(neighbours, start, max_neighbours):
    """Entries of the longest of the eight lists at `start`."""
    count = 0
    while count < max_neighbours and any_lane(load(neighbours, start + count) >= 0):
        count += 1
    return count


@inlined
def _refresh(robot, x, y, tile, start, p):
    """Updates the last step's lists at `start`: computes the distances anew and sorts by them.

    Neighbours that are out of range or hidden now drop out. Returns the entries of the longest list.
    """
    count = _longest_list(tile.neighbours, start, p.max_neighbours)
    none = splat(-1)
    for k in range(count):
        other = load(tile.neighbours, start + k)
        known = select(other >= 0, other, robot)
        dx, dy = x - gather(tile.candidate_x, known), y - gather(tile.candidate_y, known)
        dist_sq = dx * dx + dy * dy
        stays = (other >= 0) & (dist_sq < p.range_sq)
        store(tile.distances_sq, k, select(stays, dist_sq, p.range_sq))
        store(tile.neighbours, start + k, select(stays, other, none))
    for k in range(count, p.max_neighbours):
        store(tile.distances_sq, k, splat(p.range_sq))
    while _bubble_pass(count, tile, start):
        pass
    return count


@inlined
def _bubble_pass(count, tile, start):
    """One pass of bubble sort: moves the farthest entry of each list to its end; returns whether any entry moved."""
    moved = ~splat(True)
    far_sq, far = load(tile.distances_sq, 0), load(tile.neighbours, start)
    for k in range(1, count):
        next_sq, following = load(tile.distances_sq, k), load(tile.neighbours, start + k)
        swap = _precedes(next_sq, following, far_sq, far)
        moved = moved | swap
        store(tile.distances_sq, k - 1, select(swap, next_sq, far_sq))
        store(tile.neighbours, start + k - 1, select(swap, following, far))
        far_sq, far = select(swap, far_sq, next_sq), select(swap, far, following)
    if count > 0:
        store(tile.distances_sq, count - 1, far_sq)
        store(tile.neighbours, start + count - 1, far)
    return any_lane(moved)


@inlined
def _count_within(first, last, limit_sq, x, y, tile):
    """Per lane, how many of the candidates `first` to `last - 1` lie within `limit_sq` (m^2, inclusive; -1: none)."""
    hits = splat(0)
    for candidate in range(first, last):
        dx, dy = x - tile.candidate_x[candidate], y - tile.candidate_y[candidate]
        hits = hits + select(dx * dx + dy * dy <= limit_sq, 1, splat(0))
    return hits


@inlined
def _search_worlds(row, start, num_robots, num_slots, tile, p):
    """Finds the neighbours of a row's robots, each in its own world of `num_robots` robots."""
    robot = load(tile.row_slots, row)
    x, y, _, _ = gather_4(tile.pos_vel, robot)
    count = _refresh(robot, x, y, tile, start, p)
    expected = splat(0)  # hits if the list is right: its entries, and the robot itself unless it is hidden
    for k in range(count):
        expected = expected + select(load(tile.neighbours, start + k) >= 0, 1, splat(0))
    own_x = gather(tile.candidate_x, robot)
    expected = expected + select(own_x == own_x, 1, splat(0))
    limit_sq = minimum(load(tile.distances_sq, p.max_neighbours - 1), splat(p.below_range_sq))
    first = tile.row_slots[row, 0] // num_robots * num_robots
    last = min(tile.row_slots[row, LANES - 1] + 1, num_slots)
    while first < last:
        in_world = (robot >= first) & (robot < first + num_robots)
        world_limit_sq = select(in_world, limit_sq, p.minus_one)
        hits = _count_within(first, first + num_robots, world_limit_sq, x, y, tile)
        wrong = in_world & (hits != expected)
        if any_lane(wrong):
            _scan(first, first + num_robots, robot, wrong, x, y, tile, start, count, p)
        first += num_robots


@inlined
def _reduce_max(vector):
    """The largest number of a vector."""
    best = extract_lane(vector, 0)
    for i in range(1, LANES):
        best = max(best, extract_lane(vector, i))
    return best


@inlined
def _bounding_box(row, num_slots, tile):
    """(lowest x, highest x, lowest y, highest y) of a row's robots, metres."""
    pos_vel, own = tile.pos_vel, tile.row_slots[row, 0]
    low_x, high_x, low_y, high_y = pos_vel[own, 0], pos_vel[own, 0], pos_vel[own, 1], pos_vel[own, 1]
    for i in range(1, LANES):
        slot = tile.row_slots[row, i]
        if slot < num_slots:
            low_x, high_x = min(low_x, pos_vel[slot, 0]), max(high_x, pos_vel[slot, 0])
            low_y, high_y = min(low_y, pos_vel[slot, 1]), max(high_y, pos_vel[slot, 1])
    return low_x, high_x, low_y, high_y


@inlined
def _search_grid(row, start, radius_sq, num_slots, tile, p):
    """Finds the neighbours of a row's robots in the grid's cells within the largest of `radius_sq` (vector, m^2)."""
    grid = tile.grid
    _clear_lists(radius_sq, tile.distances_sq, tile.neighbours, start, p.max_neighbours)
    robot = load(tile.row_slots, row)
    x, y, _, _ = gather_4(tile.pos_vel, robot)
    own = tile.row_slots[row, 0]
    low_x, high_x, low_y, high_y = _bounding_box(row, num_slots, tile)
    # The margin covers rounding: no robot within the radius may lie in a cell that is left out.
    radius_m = math.sqrt(_reduce_max(radius_sq)) * 1.001 + 1e-6 * (abs(low_x) + abs(low_y) + 1.0)
    left, right = column_of(low_x - radius_m, grid), column_of(high_x + radius_m, grid)
    low, high = band_of(low_y - radius_m, grid), band_of(high_y + radius_m, grid)
    middle = band_of(tile.pos_vel[own, 1], grid)
    num_entries = 0
    for step in range(2 * max(high - middle, middle - low) + 1):  # the own band first, then outwards on both sides
        band = middle + (step + 1) // 2 * (1 if step % 2 else -1)
        if low <= band <= high:
            first = grid.cell_starts[band * grid.shape[0] + left]
            last = grid.cell_starts[band * grid.shape[0] + right + 1]
            num_entries = _scan(first, last, robot, splat(True), x, y, tile, start, num_entries, p)


@inlined
def find_neighbours(row, tile_index, num_robots, num_slots, tile, p):
    """Finds the neighbours of a row's robots.

    Small worlds reuse the lists of the last step. They are refreshed, and a list is right if no other robot lies
    within its farthest entry; only the robots of other lists search. Large worlds search the grid, and reuse a radius
    in which the search begins; if a list does not get full within it, the row searches the whole range.

    Args:
      row: the row.
      tile_index: index of the tile in the batch.
      num_robots: robots of a world.
      num_slots: robots of the tile.
      tile: Tile with pos_vel, candidate_x, candidate_y, candidate_slot, and neighbours or search_radius_sq of the last
        step; neighbours and neighbour_counts are written.
      p: NeighbourParams.
    """
    start = list_start(row, tile_index, tile, p)
    if p.use_grid:
        robot = load(tile.row_slots, row)
        index = robot + tile_index * tile.search_radius_sq.shape[1]
        radius_sq = gather(tile.search_radius_sq, index)
        _search_grid(row, start, radius_sq, num_slots, tile, p)
        if any_lane((load(tile.neighbours, start + p.max_neighbours - 1) < 0) & (radius_sq < p.range_sq)):
            _search_grid(row, start, splat(p.range_sq), num_slots, tile, p)
        _store_search_radius(index, start, tile, p)
    else:
        _search_worlds(row, start, num_robots, num_slots, tile, p)
    tile.neighbour_counts[row] = _longest_list(tile.neighbours, start, p.max_neighbours)
