"""The k nearest robots within a range, nearest first, for eight robots at a time.

A search looks at a run of candidates; each candidate is compared with eight robots at once. The k nearest so far
are sorted lists of eight lanes, `distances` `[max_neighbours, 8]` (squared metres) and `neighbours`
`[rows, max_neighbours, 8]` (int32, -1 for none). Equal distances are ordered by index, whatever the
order of the candidates.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from sim_core.jit import inlined
from sim_core.lanes import (
    LANES,
    any_lane,
    gather,
    gather_4,
    lane,
    load,
    maximum,
    minimum,
    root,
    scatter,
    select,
    splat,
    store,
)
from sim_core.swarm.grid import band_of, column_of


class NeighbourParams(NamedTuple):
    """Constants of the search in the worlds' dtype."""

    capacity: int
    grid: bool
    range_sq: Any
    below_range_sq: Any
    drift_m: Any
    nowhere: Any
    infinity: Any


def neighbour_params(
    capacity: int, range_m: float, drift_m: float, dtype: Any, *, grid: bool = False
) -> NeighbourParams:
    """Constants for `capacity` neighbours within `range_m` of robots that approach `drift_m` in a step at most."""
    real = np.dtype(dtype).type
    return NeighbourParams(
        capacity,
        grid,
        real(range_m) ** 2,
        np.nextafter(real(range_m) ** 2, real(0)),
        real(drift_m),
        real(-1),
        real(np.inf),
    )


@inlined
def lists_of(row, tile_index, tile, p):
    """Vector of `tile.neighbours` where a row's lists begin; tiles that are searched by grid share one place."""
    return ((0 if p.grid else tile_index) * tile.order.shape[0] + row) * p.capacity


@inlined
def clear_lists(reach_sq, distances, neighbours, at, capacity):
    """Empties the lists at `at`: nothing found yet nearer than `reach_sq` (a vector, m^2, exclusive)."""
    nobody = splat(-1)
    for k in range(capacity):
        store(distances, k, reach_sq)
        store(neighbours, at + k, nobody)


@inlined
def _comes_before(dist_sq, slot, there_sq, there):
    """Where a robot belongs before a list's entry: nearer, or as near and of lower index."""
    return (dist_sq < there_sq) | ((dist_sq == there_sq) & (slot < there))


@inlined
def _insert(dist_sq, slot, filled, distances, neighbours, at):
    """Puts candidate `slot` into the lists where `dist_sq` is small enough; `filled` entries may change."""
    k = filled - 1
    here_sq, here = load(distances, k), load(neighbours, at + k)
    before = _comes_before(dist_sq, slot, here_sq, here)
    while k > 0:
        next_sq, following = load(distances, k - 1), load(neighbours, at + k - 1)
        before_next = _comes_before(dist_sq, slot, next_sq, following)
        store(distances, k, minimum(here_sq, maximum(next_sq, dist_sq)))
        store(neighbours, at + k, select(before_next, following, select(before, slot, here)))
        here_sq, here, before = next_sq, following, before_next
        k -= 1
    store(distances, 0, minimum(dist_sq, here_sq))
    store(neighbours, at, select(before, slot, here))


@inlined
def search(first, last, robot, inside, x, y, tile, at, filled, p):
    """Puts those of the candidates `first` to `last - 1` that are near enough into the lists at `at`.

    Args:
      first, last: the run of candidates.
      robot: int32 vector, the searching robots; none is its own neighbour.
      inside: mask of the robots that search here.
      x, y: vectors, their positions, metres.
      tile: Tile with seen_x, seen_y (metres; NaN for one that nobody perceives) and seen_slot of the candidates,
        and the lists in distances and neighbours, cleared or partly filled by earlier runs.
      at: vector of `tile.neighbours` where the lists begin.
      filled: entries that earlier runs may have filled.
      p: NeighbourParams.

    Returns:
      Entries that may be filled now.
    """
    nowhere = splat(p.nowhere)
    limit_sq = select(inside, load(tile.distances, p.capacity - 1), nowhere)
    for candidate in range(first, last):
        dx, dy = x - tile.seen_x[candidate], y - tile.seen_y[candidate]
        dist_sq = dx * dx + dy * dy
        near = dist_sq <= limit_sq
        if any_lane(near):
            slot = splat(tile.seen_slot[candidate])
            near = near & (robot != slot)
            if not p.grid:
                for k in range(filled):
                    near = near & (load(tile.neighbours, at + k) != slot)
                if not any_lane(near):
                    continue
            filled = min(filled + 1, p.capacity)
            dist_sq = select(near, dist_sq, p.infinity)
            _insert(dist_sq, slot, filled, tile.distances, tile.neighbours, at)
            limit_sq = select(inside, load(tile.distances, p.capacity - 1), nowhere)
    return filled


@inlined
def _remember_reach(hint, at, tile, p):
    """Notes for each robot how far the next step's search has to look, if nobody moves faster than expected.

    A full list's farthest neighbour is at most `drift_m` farther away a step later, and so are those before
    it: a search within that distance fills the list again.
    """
    last = p.capacity - 1
    reach_m = root(load(tile.distances, last)) + p.drift_m
    full = load(tile.neighbours, at + last) >= 0
    reach_sq = select(full, minimum(reach_m * reach_m, splat(p.range_sq)), splat(p.range_sq))
    scatter(tile.reach_sq, hint, reach_sq)


@inlined
def longest(neighbours, at, capacity):
    """Entries of the longest of the eight lists at `at`."""
    count = 0
    while count < capacity and any_lane(load(neighbours, at + count) >= 0):
        count += 1
    return count


@inlined
def _refresh(robot, x, y, tile, at, p):
    """Brings the lists at `at` from the step before up to date: new distances, sorted again.

    Neighbours that are out of range or have become invisible leave. Returns the entries of the longest list.
    """
    count = longest(tile.neighbours, at, p.capacity)
    nobody = splat(-1)
    for k in range(count):
        other = load(tile.neighbours, at + k)
        known = select(other >= 0, other, robot)
        dx, dy = x - gather(tile.seen_x, known), y - gather(tile.seen_y, known)
        dist_sq = dx * dx + dy * dy
        stays = (other >= 0) & (dist_sq < p.range_sq)
        store(tile.distances, k, select(stays, dist_sq, p.range_sq))
        store(tile.neighbours, at + k, select(stays, other, nobody))
    for k in range(count, p.capacity):
        store(tile.distances, k, splat(p.range_sq))
    while _sort_pass(count, tile, at):
        pass
    return count


@inlined
def _sort_pass(count, tile, at):
    """Carries the farthest of each list to its end; returns whether anything has moved."""
    moved = ~splat(True)
    far_sq, far = load(tile.distances, 0), load(tile.neighbours, at)
    for k in range(1, count):
        next_sq, following = load(tile.distances, k), load(tile.neighbours, at + k)
        swap = _comes_before(next_sq, following, far_sq, far)
        moved = moved | swap
        store(tile.distances, k - 1, select(swap, next_sq, far_sq))
        store(tile.neighbours, at + k - 1, select(swap, following, far))
        far_sq, far = select(swap, far_sq, next_sq), select(swap, far, following)
    if count > 0:
        store(tile.distances, count - 1, far_sq)
        store(tile.neighbours, at + count - 1, far)
    return any_lane(moved)


@inlined
def _count_within(first, last, limit_sq, x, y, tile):
    """How many of the candidates lie within `limit_sq` (inclusive; negative for robots that do not ask)."""
    hits = splat(0)
    for candidate in range(first, last):
        dx, dy = x - tile.seen_x[candidate], y - tile.seen_y[candidate]
        hits = hits + select(dx * dx + dy * dy <= limit_sq, 1, splat(0))
    return hits


@inlined
def _search_worlds(row, at, size, num_slots, tile, p):
    """Searches, for a row's robots, the worlds of `size` robots that they are in."""
    robot = load(tile.order, row)
    x, y, _, _ = gather_4(tile.body, robot)
    count = _refresh(robot, x, y, tile, at, p)
    entries = splat(0)
    for k in range(count):
        entries = entries + select(load(tile.neighbours, at + k) >= 0, 1, splat(0))
    seen = gather(tile.seen_x, robot)
    entries = entries + select(seen == seen, 1, splat(0))
    limit_sq = minimum(load(tile.distances, p.capacity - 1), splat(p.below_range_sq))
    first = tile.order[row, 0] // size * size
    last = min(tile.order[row, LANES - 1] + 1, num_slots)
    while first < last:
        inside = (robot >= first) & (robot < first + size)
        hits = _count_within(first, first + size, select(inside, limit_sq, p.nowhere), x, y, tile)
        asks = inside & (hits != entries)
        if any_lane(asks):
            search(first, first + size, robot, asks, x, y, tile, at, count, p)
        first += size


@inlined
def largest(vector):
    """The largest of the eight numbers."""
    best = lane(vector, 0)
    for i in range(1, LANES):
        best = max(best, lane(vector, i))
    return best


@inlined
def body_box(row, num_slots, tile):
    """(lowest x, highest x, lowest y, highest y) of a row's robots, metres."""
    own = tile.order[row, 0]
    low_x, high_x, low_y, high_y = tile.body[own, 0], tile.body[own, 0], tile.body[own, 1], tile.body[own, 1]
    for i in range(1, LANES):
        slot = tile.order[row, i]
        if slot < num_slots:
            low_x, high_x = min(low_x, tile.body[slot, 0]), max(high_x, tile.body[slot, 0])
            low_y, high_y = min(low_y, tile.body[slot, 1]), max(high_y, tile.body[slot, 1])
    return low_x, high_x, low_y, high_y


@inlined
def _search_cells(row, at, reach_sq, num_slots, tile, p):
    """Searches, for a row's robots, the grid's cells within the largest of `reach_sq`."""
    grid = tile.grid
    clear_lists(reach_sq, tile.distances, tile.neighbours, at, p.capacity)
    robot = load(tile.order, row)
    x, y, _, _ = gather_4(tile.body, robot)
    own = tile.order[row, 0]
    low_x, high_x, low_y, high_y = body_box(row, num_slots, tile)
    # the margin covers rounding: a robot within reach must not lie in a cell outside
    reach_m = math.sqrt(largest(reach_sq)) * 1.001 + 1e-6 * (abs(low_x) + abs(low_y) + 1.0)
    left, right = column_of(low_x - reach_m, grid), column_of(high_x + reach_m, grid)
    low, high = band_of(low_y - reach_m, grid), band_of(high_y + reach_m, grid)
    middle = band_of(tile.body[own, 1], grid)
    filled = 0
    for step in range(2 * max(high - middle, middle - low) + 1):  # the own band first, then those on either side
        band = middle + (step + 1) // 2 * (1 if step % 2 else -1)
        if low <= band <= high:
            first = grid.starts[band * grid.shape[0] + left]
            last = grid.starts[band * grid.shape[0] + right + 1]
            filled = search(first, last, robot, splat(True), x, y, tile, at, filled, p)


@inlined
def find_neighbours(row, tile_index, size, num_slots, tile, p):
    """Finds the neighbours of a row's robots.

    What is known from the step before speeds the search up and never changes its result. In small worlds these are the
    lists themselves: once up to date, they are right if no other robot lies within their farthest entry. By grid
    it is a radius to begin within; a robot that finds fewer than it may have there is searched for in the whole range.

    Args:
      row: the row.
      tile_index: which tile of the batch this is.
      size: robots in a world.
      num_slots: robots in the tile.
      tile: Tile with body, seen_x, seen_y, seen_slot and what it remembers; neighbours and counts are written.
      p: NeighbourParams.
    """
    at = lists_of(row, tile_index, tile, p)
    if p.grid:
        robot = load(tile.order, row)
        hint = robot + tile_index * tile.reach_sq.shape[1]
        reach_sq = gather(tile.reach_sq, hint)
        _search_cells(row, at, reach_sq, num_slots, tile, p)
        if any_lane((load(tile.neighbours, at + p.capacity - 1) < 0) & (reach_sq < p.range_sq)):
            _search_cells(row, at, splat(p.range_sq), num_slots, tile, p)
        _remember_reach(hint, at, tile, p)
    else:
        _search_worlds(row, at, size, num_slots, tile, p)
    tile.counts[row] = longest(tile.neighbours, at, p.capacity)
