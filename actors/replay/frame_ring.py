"""Ring of a replay shard's frames: next observations that are not the observation of any row (see `packing`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from actors.service.packing import as_bytes
from actors.storage.ring_snapshot import RingSnapshot
from actors.storage.zarr_columns import load_rows

MIN_CAPACITY = 1_024
"""Capacity of a new ring."""
MAX_NUMBER = 2**62
"""Upper bound on the number of a frame."""


class FrameRing:
    """A first-in, first-out ring of frames that doubles its capacity when it is full.

    Frames are numbered in the order of insertion; frame k is in slot k modulo the capacity, a power of 2.

    Args:
      observation: dtype of one frame, its shape included.
    """

    def __init__(self, observation: np.dtype[Any]) -> None:
        self._dtype = np.dtype([("observation", observation)])
        self._ring = np.zeros(MIN_CAPACITY, self._dtype)
        self._first = 0
        self._next = 0
        self._snapshot = RingSnapshot(self._ring, 0)

    @property
    def slots(self) -> NDArray[Any]:
        """All slots `[capacity]`, used and free, with the one field `observation`."""
        return self._ring

    @property
    def numbers(self) -> range:
        """Numbers of the frames held."""
        return range(self._first, self._next)

    def release(self, count: int) -> None:
        """Frees the slots of the oldest `count` frames."""
        self._first += count

    def push(self, frames: NDArray[Any]) -> int:
        """Inserts frames `[count, *shape]` of the ring's dtype; returns the number of the first one."""
        number = self._next
        self._grow(self._next - self._first + len(frames))
        self._write(number, as_bytes(frames))
        self._next += len(frames)
        return number

    def _write(self, number: int, frames: NDArray[np.uint8]) -> None:
        start, memory = number % len(self._ring), as_bytes(self._ring)
        first = min(len(frames), len(self._ring) - start)
        for begin, piece in ((start, frames[:first]), (0, frames[first:])):
            self._snapshot.protect(begin, begin + len(piece))
            memory[begin : begin + len(piece)] = piece

    def _grow(self, count: int) -> None:
        """Doubles the capacity until it is at least `count`; a snapshot keeps the old memory, which stays unchanged."""
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
        """Takes a snapshot of all slots, in the order of `slots`; earlier snapshots become invalid."""
        self._snapshot = RingSnapshot(self._ring, len(self._ring))
        return self._snapshot

    def get_state(self) -> list[int]:
        """First frame number held and the next one to be given, for JSON; `snapshot` holds the frames."""
        return [self._first, self._next]

    def load(self, path: Path, state: list[int], at_most: int) -> None:
        """Restores the ring.

        Args:
          path: zarr group of a saved `snapshot`.
          state: the `get_state` of the same moment.
          at_most: most frames that the shard can need.

        Raises:
          ValueError: the frames are damaged, do not match the state, or are more than `at_most` frames need.
        """
        if not (isinstance(state, list) and len(state) == 2 and all(type(number) is int for number in state)):
            raise ValueError(f"the numbers of the frames at {path} are {state!r}, not two whole numbers")
        (first, after), most = state, max(MIN_CAPACITY, 1 << (at_most - 1).bit_length())
        ring = load_rows(path, self._dtype, at_most=most)
        capacity = len(ring)
        is_power_of_2 = capacity & (capacity - 1) == 0
        is_in_range = 0 <= first <= after <= min(first + capacity, MAX_NUMBER)
        if capacity < MIN_CAPACITY or not is_power_of_2 or not is_in_range:
            raise ValueError(f"{path} has {capacity} slots, which is no ring of frames {first} to {after}")
        self._ring, self._first, self._next = ring, first, after
        self._snapshot = RingSnapshot(self._ring, 0)
