"""The rows of a ring as they were at one moment, read by another thread while the ring is written on.

Copy on write: a piece is copied when the reader comes to it, or just before the ring overwrites it, whichever is
first. So taking a snapshot costs nothing, whatever the ring holds, and no insert waits for more than a few pieces.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

PIECE_ROWS = 4_096
"""Rows that are copied at once."""


class RingSnapshot:
    """Rows 0..size of a ring at the moment of construction; may be read once, in ascending slices.

    Args:
      rows: the ring's rows `[capacity]`; their owner calls `protect` before it overwrites any.
      size: rows that count, from the first on.
    """

    def __init__(self, rows: NDArray[Any], size: int) -> None:
        self._ring = rows
        self._size = size
        self._lock = threading.Lock()
        self._saved: dict[int, NDArray[Any]] = {}
        self._first = 0  # pieces before this one have been read

    @property
    def dtype(self) -> np.dtype[Any]:
        """Layout of the rows."""
        return self._ring.dtype

    def __len__(self) -> int:
        """Rows of the snapshot."""
        return self._size

    def protect(self, start: int, stop: int) -> None:
        """Copies what has not been read yet of the pieces with ring rows start..stop, which are to be overwritten."""
        if start >= min(stop, self._size):
            return
        with self._lock:
            for piece in range(max(self._first, start // PIECE_ROWS), -(-min(stop, self._size) // PIECE_ROWS)):
                if piece not in self._saved:
                    self._saved[piece] = self._copy(piece)

    def _copy(self, piece: int) -> NDArray[Any]:
        return self._ring[piece * PIECE_ROWS : min(self._size, (piece + 1) * PIECE_ROWS)].copy()

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Copies of the rows start..stop as they were; start is a multiple of PIECE_ROWS."""
        pieces = []
        for piece in range(start // PIECE_ROWS, -(-min(stop, self._size) // PIECE_ROWS)):
            with self._lock:
                saved = self._saved.pop(piece, None)
                pieces.append(self._copy(piece) if saved is None else saved)
                self._first = piece + 1
        return np.concatenate(pieces) if pieces else self._ring[:0].copy()

    def close(self) -> None:
        """Frees what was copied; inserts protect nothing any more."""
        with self._lock:
            self._size = 0
            self._saved.clear()
