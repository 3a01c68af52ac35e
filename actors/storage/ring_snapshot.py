"""Copy-on-write snapshots of a ring buffer: another thread reads the rows of one moment while inserts continue.

A piece of the ring is copied when the reader reaches it, or just before an insert overwrites it, whichever comes first.
So a snapshot costs nothing to take, whatever the size of the ring, and no insert waits for more than a few pieces.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

PIECE_ROWS = 4_096
"""Rows copied at a time."""


class RingSnapshot:
    """Rows `0:size` of a ring at the moment of construction; may be read once, in ascending slices.

    Args:
      rows: the ring `[capacity]`; its owner calls `protect` before it overwrites any row.
      size: number of rows in the snapshot.
    """

    def __init__(self, rows: NDArray[Any], size: int) -> None:
        self._ring = rows
        self._size = size
        self._lock = threading.Lock()
        self._saved: dict[int, NDArray[Any]] = {}
        self._first = 0  # pieces before this one have been read

    @property
    def dtype(self) -> np.dtype[Any]:
        """Structured dtype of the rows."""
        return self._ring.dtype

    def __len__(self) -> int:
        """Number of rows."""
        return self._size

    def protect(self, start: int, stop: int) -> None:
        """Saves the unread pieces that hold rows `start:stop`, which the ring is about to overwrite."""
        if start >= min(stop, self._size):
            return
        with self._lock:
            for piece in range(max(self._first, start // PIECE_ROWS), -(-min(stop, self._size) // PIECE_ROWS)):
                if piece not in self._saved:
                    self._saved[piece] = self._copy(piece)

    def _copy(self, piece: int) -> NDArray[Any]:
        return self._ring[piece * PIECE_ROWS : min(self._size, (piece + 1) * PIECE_ROWS)].copy()

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Copies rows `start:stop` as they were at the snapshot; `start` is a multiple of PIECE_ROWS."""
        pieces = []
        for piece in range(start // PIECE_ROWS, -(-min(stop, self._size) // PIECE_ROWS)):
            with self._lock:
                saved = self._saved.pop(piece, None)
                pieces.append(self._copy(piece) if saved is None else saved)
                self._first = piece + 1
        return np.concatenate(pieces) if pieces else self._ring[:0].copy()

    def close(self) -> None:
        """Frees the copies; from now on `protect` does nothing."""
        with self._lock:
            self._size = 0
            self._saved.clear()
