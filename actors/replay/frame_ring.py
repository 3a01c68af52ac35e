"""The frames of a replay shard: observations that its rows led to and that no row of it begins with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from actors.service.packing import as_bytes
from actors.storage.ring_snapshot import RingSnapshot
from actors.storage.zarr_columns import load_rows

SMALLEST = 1_024
"""Frames that there is room for at first."""
LAST = 2**62
"""No number of a frame is greater."""


class FrameRing:
    """Frames in the order that they came, until they are released in the same order; grows when it is full.

    Frame k stands at k modulo the capacity, a power of 2.

    Args:
      observation: dtype and shape of one frame, as `np.dtype` has them in one.
    """

    def __init__(self, observation: np.dtype[Any]) -> None:
        self._dtype = np.dtype([("observation", observation)])
        self._ring = np.zeros(SMALLEST, self._dtype)
        self._first = 0
        self._next = 0
        self._snapshot = RingSnapshot(self._ring, 0)

    @property
    def frames(self) -> NDArray[Any]:
        """All places, `[capacity]`."""
        return self._ring

    @property
    def numbers(self) -> range:
        """Numbers of the frames held."""
        return range(self._first, self._next)

    def release(self, count: int) -> None:
        """Gives the places of the oldest `count` frames back."""
        self._first += count

    def push(self, frames: NDArray[Any]) -> int:
        """Takes frames `[count, *shape]` of the ring's dtype; returns the number of the first one."""
        number = self._next
        self._make_room(self._next - self._first + len(frames))
        self._write(number, as_bytes(frames))
        self._next += len(frames)
        return number

    def _write(self, number: int, frames: NDArray[np.uint8]) -> None:
        start, memory = number % len(self._ring), as_bytes(self._ring)
        first = min(len(frames), len(self._ring) - start)
        for begin, part in ((start, frames[:first]), (0, frames[first:])):
            self._snapshot.protect(begin, begin + len(part))
            memory[begin : begin + len(part)] = part

    def _make_room(self, count: int) -> None:
        """Doubles the ring until it has `count` places; a snapshot keeps the old one, which changes no more."""
        if count <= len(self._ring):
            return
        old, start, held = as_bytes(self._ring), self._first % len(self._ring), self._next - self._first
        self._ring = np.zeros(1 << (count - 1).bit_length(), self._dtype)
        self._snapshot = RingSnapshot(self._ring, 0)
        self._write(self._first, old[start : start + held])
        rest = start + held - len(old)
        if rest > 0:
            self._write(self._next - rest, old[:rest])

    def snapshot(self) -> RingSnapshot:
        """All places as they are now; one taken before may not be written any more."""
        self._snapshot = RingSnapshot(self._ring, len(self._ring))
        return self._snapshot

    def get_state(self) -> list[int]:
        """The range of the frames' numbers, for JSON; the frames are in `snapshot`."""
        return [self._first, self._next]

    def load(self, path: Path, state: list[int], at_most: int) -> None:
        """Takes up the places of a `snapshot` that were saved at `path`, and the `get_state` of the same moment.

        Raises:
          ValueError: they are damaged, do not fit each other, or are more than `at_most` frames ask for.
        """
        if not (isinstance(state, list) and len(state) == 2 and all(type(number) is int for number in state)):
            raise ValueError(f"the numbers of the frames at {path} are {state!r}, not two whole numbers")
        (first, after), most = state, max(SMALLEST, 1 << (at_most - 1).bit_length())
        ring = load_rows(path, self._dtype, at_most=most)
        places = len(ring)
        if places < SMALLEST or places & (places - 1) or not 0 <= first <= after <= min(first + places, LAST):
            raise ValueError(f"{path} has {places} places, which is no ring of frames {first} to {after}")
        self._ring, self._first, self._next = ring, first, after
        self._snapshot = RingSnapshot(self._ring, 0)
