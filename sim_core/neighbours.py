"""The k nearest robots within a range, nearest first, for eight robots at a time.

A search looks at a run of candidates; each candidate is compared with eight robots at once. The k nearest so far
are sorted lists of eight lanes, `distances` `[max_neighbours, 8]` (squared metres) and `neighbours`
`[rows, max_neighbours, 8]` (int32, -1 for none). Equal distances are ordered by index, whatever the
order of the candidates.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sim_core.jit import inlined
from sim_core.lanes import any_lane, gather, gather_4, load, maximum, minimum, root, scatter, select, splat, store


class NeighbourParams(NamedTuple):
    """Constants of the search in the worlds' dtype."""

    capacity: int
    range_sq: Any
    drift_m: Any
    nowhere: Any
    infinity: Any


def neighbour_params(capacity: int, range_m: float, drift_m: float, dtype: Any) -> NeighbourParams:
    """Constants for `capacity` neighbours within `range_m` of robots that approach `drift_m` in a step at most."""
    real = np.dtype(dtype).type
    return NeighbourParams(capacity, real(range_m) ** 2, real(drift_m), real(-1), real(np.inf))


@inlined
def clear_lists(reach_sq, distances, neighbours, at, capacity):
    """Empties the lists at `at`: nothing found yet nearer than `reach_sq` (a vector, m^2, exclusive)."""
    nobody = splat(-1)
    for k in range(capacity):
        store(distances, k, reach_sq)
        store(neighbours, at + k, nobody)


@inlined
def _insert(dist_sq, slot, filled, distances, neighbours, at):
    """Puts candidate `slot` into the lists where `dist_sq` is small enough; `filled` entries may change."""
    k = filled - 1
    here_sq, here = load(distances, k), load(neighbours, at + k)
    before = (dist_sq < here_sq) | ((dist_sq == here_sq) & (slot < here))
    while k > 0:
        next_sq, following = load(distances, k - 1), load(neighbours, at + k - 1)
        before_next = (dist_sq < next_sq) | ((dist_sq == next_sq) & (slot < following))
        store(distances, k, minimum(here_sq, maximum(next_sq, dist_sq)))
        store(neighbours, at + k, select(before_next, following, select(before, slot, here)))
        here_sq, here, before = next_sq, following, before_next
        k -= 1
    store(distances, 0, minimum(dist_sq, here_sq))
    store(neighbours, at, select(before, slot, here))


@inlined
def search(first, last, robot, inside, x, y, seen_x, seen_y, seen_slot, distances, neighbours, at, p):
    """Puts those of the candidates `first` to `last - 1` that are near enough into the lists at `at`.

    Args:
      first, last: the run of candidates.
      robot: int32 vector, the searching robots; none is its own neighbour.
      inside: mask of the robots that search here.
      x, y: vectors, their positions, metres.
      seen_x, seen_y: `[candidates]`, positions, metres; NaN for one that nobody perceives.
      seen_slot: `[candidates]` int32, their indices.
      distances, neighbours, at: the lists, cleared or partly filled by earlier runs.
      p: NeighbourParams.
    """
    nowhere = splat(p.nowhere)
    limit_sq = select(inside, load(distances, p.capacity - 1), nowhere)
    filled = 0
    for candidate in range(first, last):
        dx, dy = x - seen_x[candidate], y - seen_y[candidate]
        dist_sq = dx * dx + dy * dy
        near = dist_sq <= limit_sq
        if any_lane(near):
            slot = splat(seen_slot[candidate])
            near = near & (robot != slot)
            filled = min(filled + 1, p.capacity)
            _insert(select(near, dist_sq, p.infinity), slot, filled, distances, neighbours, at)
            limit_sq = select(inside, load(distances, p.capacity - 1), nowhere)


@inlined
def remember_reach(robot, at, distances, neighbours, reach_sq, p):
    """Notes for each robot how far the next step's search has to look, if nobody moves faster than expected.

    A full list's farthest neighbour is at most `drift_m` farther away a step later, and so are those before
    it: a search within that distance fills the list again. It is a guess, never trusted: see `find_neighbours`.
    """
    last = p.capacity - 1
    reach_m = root(load(distances, last)) + p.drift_m
    full = load(neighbours, at + last) >= 0
    scatter(reach_sq, robot, select(full, minimum(reach_m * reach_m, splat(p.range_sq)), splat(p.range_sq)))


@inlined
def longest(neighbours, at, capacity):
    """Entries of the longest of the eight lists at `at`."""
    count = 0
    while count < capacity and any_lane(load(neighbours, at + count) >= 0):
        count += 1
    return count


@inlined
def _search_worlds(row, size, num_slots, tile, p):
    """Searches, for a row's robots, the worlds of `size` robots that they are in."""
    robot = load(tile.order, row)
    x, y, _, _ = gather_4(tile.body, robot)
    at = row * p.capacity
    first = tile.order[row, 0] // size * size
    last = min(tile.order[row, 7] + 1, num_slots)
    while first < last:
        inside = (robot >= first) & (robot < first + size)
        search(
            first,
            first + size,
            robot,
            inside,
            x,
            y,
            tile.seen_x,
            tile.seen_y,
            tile.seen_slot,
            tile.distances,
            tile.neighbours,
            at,
            p,
        )
        first += size


@inlined
def find_neighbours(row, size, num_slots, tile, p):
    """Finds the neighbours of a row's robots.

    The search begins within each robot's `reach_sq`; a robot that finds fewer than it may have there is searched
    for again in the whole range, so that the result never depends on the guess.

    Args:
      row: the row.
      size: robots in a world.
      num_slots: robots in the tile.
      tile: Tile with body, seen_x, seen_y, seen_slot, reach_sq; neighbours, counts and reach_sq are written.
      p: NeighbourParams.
    """
    robot = load(tile.order, row)
    at = row * p.capacity
    reach_sq = gather(tile.reach_sq, robot)
    clear_lists(reach_sq, tile.distances, tile.neighbours, at, p.capacity)
    _search_worlds(row, size, num_slots, tile, p)
    if any_lane((load(tile.neighbours, at + p.capacity - 1) < 0) & (reach_sq < p.range_sq)):
        clear_lists(splat(p.range_sq), tile.distances, tile.neighbours, at, p.capacity)
        _search_worlds(row, size, num_slots, tile, p)
    remember_reach(robot, at, tile.distances, tile.neighbours, tile.reach_sq, p)
    tile.counts[row] = longest(tile.neighbours, at, p.capacity)
