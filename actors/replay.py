"""A replay shard: a preallocated ring of packed transitions with uniform sampling.

One plain class for both placements (in the learner's process, or as a Ray actor of its own).
"""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.ring_snapshot import RingSnapshot
from actors.storage import load_rows, save_rows
from actors.transitions import SCHEMA_VERSION, BlockHeader, SampleReply, TransitionBlock


class Stored(NamedTuple):
    """How a shard took a block: rows stored, or why none."""

    rows: int
    duplicate: bool


class ShardSnapshot:
    """What a shard holds at one moment, for another thread to write while the shard is written on.

    Args:
      rows: its rows.
    """

    def __init__(self, rows: RingSnapshot) -> None:
        self.rows = rows

    def save(self, path: Path) -> None:
        """Writes the rows to a zarr group at `path`, once."""
        with closing(self.rows):
            save_rows(path, self.rows)

    def close(self) -> None:
        """Frees what nobody will write."""
        self.rows.close()


class ReplayShard:
    """Holds the newest `capacity` transitions; overwrites the oldest.

    Pushes are at-least-once: a block that was stored before, or that comes from an older start of its
    worker, is dropped and counted.

    Args:
      dtype: the packed row (`actors.transitions.transition_dtype`).
      capacity: transitions to hold.
      seed: seed of the sampling stream.
    """

    def __init__(self, dtype: np.dtype[Any], capacity: int, seed: int) -> None:
        self._rows = np.zeros(capacity, dtype)
        self._bytes = self._rows.view(np.uint8).reshape(capacity, dtype.itemsize)
        self._next = 0
        self._size = 0
        self._inserted = 0
        self._dropped = 0
        self._newest: dict[int, tuple[int, int]] = {}
        self._rng = np.random.Generator(np.random.PCG64(seed))
        self._snapshot = RingSnapshot(self._rows, 0)

    @property
    def size(self) -> int:
        """Transitions held."""
        return self._size

    @property
    def mass(self) -> float:
        """What this shard counts when one of several is drawn: its size, as every row counts alike."""
        return float(self._size)

    @property
    def inserted(self) -> int:
        """Transitions stored since the start, overwritten ones included."""
        return self._inserted

    @property
    def dropped(self) -> int:
        """Transitions of duplicate or outdated blocks, never stored."""
        return self._dropped

    def add(self, block: TransitionBlock) -> Stored:
        """Stores a block once.

        Raises:
          ValueError: the block has another schema or row layout.
        """
        header = block.header
        if header.schema_version != SCHEMA_VERSION or block.rows.dtype != self._rows.dtype:
            raise ValueError(
                f"block of worker {header.worker_id} has schema {header.schema_version} and rows {block.rows.dtype}, "
                f"this shard takes schema {SCHEMA_VERSION} and rows {self._rows.dtype}"
            )
        if not self._is_new(header):
            self._dropped += len(block.rows)
            return Stored(0, True)
        self._newest[header.worker_id] = (header.incarnation, header.sequence)
        self._write(block.rows)
        return Stored(len(block.rows), False)

    def fence(self, worker_id: int, incarnation: int) -> None:
        """Refuses blocks of older starts of a worker from now on."""
        fence = (incarnation, -1)
        self._newest[worker_id] = max(self._newest.get(worker_id, fence), fence)

    def _is_new(self, header: BlockHeader) -> bool:
        last = self._newest.get(header.worker_id)
        return last is None or (header.incarnation, header.sequence) > last

    def _write(self, rows: NDArray[Any]) -> None:
        self._inserted += len(rows)
        capacity = len(self._rows)
        rows = rows[-capacity:]
        packed = rows.view(np.uint8).reshape(len(rows), rows.dtype.itemsize)  # not field by field: half the time
        first = min(len(rows), capacity - self._next)
        self._snapshot.protect(self._next, self._next + first)
        self._snapshot.protect(0, len(rows) - first)
        self._bytes[self._next : self._next + first] = packed[:first]
        self._bytes[: len(rows) - first] = packed[first:]
        self._next = (self._next + len(rows)) % capacity
        self._size = min(self._size + len(rows), capacity)

    def sample(self, count: int) -> SampleReply:
        """Draws `count` rows uniformly with replacement.

        Raises:
          ValueError: the shard is empty.
        """
        self._refuse_if_empty()
        slots = self._rng.integers(self._size, size=count)
        return SampleReply(self._take(slots), self.mass, None)

    def _refuse_if_empty(self) -> None:
        if self._size == 0:
            raise ValueError("an empty replay shard cannot be sampled")

    def _take(self, slots: NDArray[np.int64]) -> NDArray[Any]:
        taken = np.take(self._bytes, slots, axis=0, mode="clip")
        return taken.view(self._rows.dtype).reshape(len(slots))

    def get_state(self) -> dict[str, Any]:
        """Counters and random stream, for JSON; the rows are in `snapshot`."""
        return {
            "next": self._next,
            "size": self._size,
            "inserted": self._inserted,
            "dropped": self._dropped,
            "newest": [[worker, *last] for worker, last in self._newest.items()],
            "rng": self._rng.bit_generator.state,
        }

    def snapshot(self) -> ShardSnapshot:
        """What the shard holds now; one taken before may not be written any more."""
        return ShardSnapshot(self._ring_snapshot())

    def _ring_snapshot(self) -> RingSnapshot:
        self._snapshot = RingSnapshot(self._rows, self._size)
        return self._snapshot

    def load(self, path: Path, state: dict[str, Any]) -> None:
        """Takes up the rows of a `snapshot` that were saved at `path`, and the `get_state` of the same moment.

        Raises:
          ValueError: the saved rows do not fit this shard.
        """
        rows = load_rows(path, self._rows.dtype, at_most=len(self._rows))
        if len(rows) != state["size"]:
            raise ValueError(f"{path} holds {len(rows)} transitions, not the {state['size']} of its checkpoint")
        capacity = len(self._rows)
        if state["next"] != (len(rows) if len(rows) < capacity else state["next"] % capacity):
            raise ValueError(f"{path} is the ring of a shard with another capacity than {capacity}")
        self._rows[: len(rows)] = rows
        self._next, self._size = state["next"], state["size"]
        self._inserted, self._dropped = state["inserted"], state["dropped"]
        self._newest = {worker: (incarnation, sequence) for worker, incarnation, sequence in state["newest"]}
        self._rng.bit_generator.state = state["rng"]
