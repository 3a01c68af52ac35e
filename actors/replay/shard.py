"""A replay shard: a preallocated ring of packed transitions, and the ring of their frames, with uniform sampling.

One plain class for both placements (in the learner's process, or as a Ray actor of its own).
"""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.replay.frame_ring import FrameRing
from actors.service.messages import SCHEMA_VERSION, BlockHeader, SampleReply, TransitionBlock
from actors.service.packing import Packed, Unpacker, as_bytes, count_frames, leads, packed_dtype, renumber
from actors.storage.ring_snapshot import RingSnapshot
from actors.storage.zarr_columns import load_rows, save_rows

FRAMES = "frames"
"""Name of the saved frames' group."""


class Stored(NamedTuple):
    """How a shard took a block: rows stored, or why none."""

    rows: int
    duplicate: bool


class ShardSnapshot:
    """What a shard holds at one moment, for another thread to write while the shard is written on.

    Args:
      rows: its packed rows.
      frames: the places of its frames.
    """

    def __init__(self, rows: RingSnapshot, frames: RingSnapshot) -> None:
        self.rows, self.frames = rows, frames

    def save(self, path: Path) -> None:
        """Writes the rows to a zarr group at `path`, once, and the frames to one within it."""
        with closing(self):
            save_rows(path, self.rows)
            save_rows(path / FRAMES, self.frames)

    def close(self) -> None:
        """Frees what nobody will write."""
        self.rows.close()
        self.frames.close()


class ReplayShard:
    """Holds the newest `capacity` transitions; overwrites the oldest.

    Pushes are at-least-once: a block that was stored before, or that comes from an older start of its
    worker, is dropped and counted.

    Args:
      dtype: of the transitions that are drawn (`actors.service.messages.transition_dtype`).
      capacity: transitions to hold.
      seed: seed of the sampling stream.
    """

    def __init__(self, dtype: np.dtype[Any], capacity: int, seed: int) -> None:
        self._rows = np.zeros(capacity, packed_dtype(dtype))
        self._unpack = Unpacker(self._rows)
        self._frames = FrameRing(dtype["observation"])
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
          ValueError: the block has another schema or layout, or its rows do not fit its frames.
        """
        header, count = block.header, block.transitions
        rows, frames = block.packed
        if header.schema_version != SCHEMA_VERSION or not block.packed.is_sound(self._rows.dtype):
            raise ValueError(
                f"block of worker {header.worker_id} has schema {header.schema_version}, rows {rows.dtype}, and "
                f"{len(frames)} frames {frames.dtype}{frames.shape[1:]}; this shard takes schema {SCHEMA_VERSION}, "
                f"rows {self._rows.dtype}, and the frames that they lead to"
            )
        if not self._is_new(header):
            self._dropped += count
            return Stored(0, True)
        self._newest[header.worker_id] = (header.incarnation, header.sequence)
        self._write(block.packed)
        return Stored(count, False)

    def fence(self, worker_id: int, incarnation: int) -> None:
        """Refuses blocks of older starts of a worker from now on."""
        fence = (incarnation, -1)
        self._newest[worker_id] = max(self._newest.get(worker_id, fence), fence)

    def _is_new(self, header: BlockHeader) -> bool:
        last = self._newest.get(header.worker_id)
        return last is None or (header.incarnation, header.sequence) > last

    def _write(self, packed: Packed) -> None:
        rows, capacity = packed.rows, len(self._rows)
        self._inserted += len(rows)
        rows = rows[-capacity:]
        first = min(len(rows), capacity - self._next)
        pieces = ((self._next, rows[:first]), (0, rows[first:]))
        for start, piece in pieces:
            self._give_up(start, start + len(piece))
        passed_over = count_frames(packed.rows[: len(packed.rows) - len(rows)])
        number = self._frames.push(packed.frames[passed_over:]) - passed_over
        for start, piece in pieces:
            stored = self._rows[start : start + len(piece)]
            as_bytes(stored)[...] = as_bytes(piece)  # not field by field: half the time
            renumber(stored["next_row"], number)
        self._next = (self._next + len(rows)) % capacity
        self._size = min(self._size + len(rows), capacity)

    def _give_up(self, start: int, stop: int) -> None:
        """Prepares slots to be overwritten."""
        self._snapshot.protect(start, stop)
        self._frames.release(count_frames(self._rows[start : min(stop, self._size)]))

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

    def _take(self, slots: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        return self._unpack(slots, self._frames.frames)

    def get_state(self) -> dict[str, Any]:
        """Counters and random stream, for JSON; rows and frames are in `snapshot`."""
        return {
            "next": self._next,
            "size": self._size,
            "inserted": self._inserted,
            "dropped": self._dropped,
            "frames": self._frames.get_state(),
            "newest": [[worker, *last] for worker, last in self._newest.items()],
            "rng": self._rng.bit_generator.state,
        }

    def snapshot(self) -> ShardSnapshot:
        """What the shard holds now; one taken before may not be written any more."""
        return ShardSnapshot(*self._ring_snapshots())

    def _ring_snapshots(self) -> tuple[RingSnapshot, RingSnapshot]:
        self._snapshot = RingSnapshot(self._rows, self._size)
        return self._snapshot, self._frames.snapshot()

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
        frames = FrameRing(self._rows.dtype["observation"])
        frames.load(path / FRAMES, state["frames"], at_most=capacity)
        if not leads(np.roll(rows["next_row"], -state["next"]), frames.numbers):
            raise ValueError(f"{path} has rows that lead to observations which it does not hold")
        self._rows[: len(rows)], self._frames = rows, frames
        self._next, self._size = state["next"], state["size"]
        self._inserted, self._dropped = state["inserted"], state["dropped"]
        self._newest = {worker: (incarnation, sequence) for worker, incarnation, sequence in state["newest"]}
        self._rng.bit_generator.state = state["rng"]
