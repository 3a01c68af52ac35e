"""Packed transitions: every observation is stored once.

The next observation of step t is the observation of step t + n of the same environment. A packed row therefore holds
the distance to the row of step t + n in place of a copy. Some next observations are not the observation of any row: the
last one of an episode, and those whose step belongs to a later block. These are stored beside the rows, as frames.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_core.jit import inlined, kernel

FRAME_MODULUS = 2**31
"""Rows refer to the frames of a shard, counted in the order of insertion, modulo this number."""

BATCH_ROWS = 16
"""Rows unpacked together, so that their cache misses overlap: about as many as a core has in flight."""


class Packed(NamedTuple):
    """Transitions, oldest first.

    rows: `[count]` of `packed_dtype`. A positive `next_row` is the distance to the row whose observation is this row's
      next observation. Otherwise the next observation is frame number `-next_row`. Frames are numbered from 0 in the
      order of the rows that refer to them, one row each.
    frames: next observations that are not the observation of any row `[frames, *shape]`.
    """

    rows: NDArray[Any]
    frames: NDArray[Any]

    def is_valid(self, row: np.dtype[Any]) -> bool:
        """Whether the rows have dtype `row`, the frames the dtype and shape of its observation, and all links hold."""
        observation = row["observation"]
        frame = self.frames.dtype, self.frames.shape[1:]
        if self.rows.dtype != row or frame != (observation.base, observation.shape):
            return False
        return links_are_valid(self.rows["next_row"], range(len(self.frames)))


def packed_dtype(transition: np.dtype[Any]) -> np.dtype[Any]:
    """Structured dtype of a packed row, from that of a transition (`actors.service.messages.transition_dtype`)."""
    return np.dtype(
        [
            ("reward", np.float32),
            ("discount", np.float32),
            ("action", np.int32),
            ("next_row", np.int32),
            ("observation", transition["observation"]),
        ],
        align=True,
    )


def estimate_frames(transitions: int, steps_per_block: int, n_step: int) -> int:
    """Frames that `transitions` transitions need because their blocks end; the ends of episodes add to this."""
    return transitions * min(n_step, steps_per_block) // steps_per_block


def as_bytes(array: NDArray[Any]) -> NDArray[np.uint8]:
    """Views the entries of an array as bytes `[len(array), bytes]`; copies it if it is not contiguous."""
    size = array.dtype.itemsize * math.prod(array.shape[1:])
    return np.ascontiguousarray(array).view(np.uint8).reshape(len(array), size)


def links_are_valid(next_row: NDArray[np.int32], frames: range) -> bool:
    """Whether all links of rows, oldest first, hold.

    Args:
      next_row: the rows' field `[rows]`.
      frames: numbers of the frames present.

    Returns:
      Whether every positive `next_row` leads to one of the rows, and the others refer to all frames in order.
    """
    return bool(_links_are_valid(next_row, frames.start, frames.stop))


@kernel
def _links_are_valid(next_row: NDArray[np.int32], first: int, stop: int) -> bool:
    for i in range(len(next_row)):
        if next_row[i] > 0:
            if i + next_row[i] >= len(next_row):
                return False
        else:
            if first == stop or -next_row[i] != first % FRAME_MODULUS:
                return False
            first += 1
    return first == stop


def count_frames(rows: NDArray[Any]) -> int:
    """Number of frames that packed rows refer to."""
    return int(np.count_nonzero(rows["next_row"] <= 0))


class Fields(NamedTuple):
    """Views of packed rows: their fields `[rows]`, and the whole rows as bytes `[rows, bytes]`.

    `offset` is the byte of a row at which the observation starts. The types are the same for every observation space,
    so that kernels compile once.
    """

    reward: NDArray[np.float32]
    discount: NDArray[np.float32]
    action: NDArray[np.int32]
    next_row: NDArray[np.int32]
    row_bytes: NDArray[np.uint8]
    offset: int


def fields_of(rows: NDArray[Any]) -> Fields:
    """Views of packed rows, for kernels."""
    fields = rows.dtype.fields
    assert fields is not None
    offset = fields["observation"][1]
    return Fields(rows["reward"], rows["discount"], rows["action"], rows["next_row"], as_bytes(rows), offset)


class _Columns(NamedTuple):
    """Columns of unpacked transitions `[count]`, observations as bytes `[count, bytes]`."""

    reward: NDArray[np.float32]
    discount: NDArray[np.float32]
    action: NDArray[np.int32]
    observation: NDArray[np.uint8]
    next_observation: NDArray[np.uint8]


class Unpacker:
    """Gathers unpacked transitions from a ring of packed rows.

    Args:
      rows: the ring `[capacity]`; every call reads its present content.
    """

    def __init__(self, rows: NDArray[Any]) -> None:
        observation = rows.dtype["observation"]
        self._ring = fields_of(rows)
        self._shape, self._dtype = observation.shape, observation.base

    def __call__(self, slots: NDArray[np.int64], frames: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Gathers the transitions at `slots` `[count]`.

        Args:
          slots: slots of the ring `[count]`.
          frames: ring of frames; frame k is in slot k modulo its length, a power of 2.

        Returns:
          Columns `[count, ...]` under the names of `messages.transition_dtype`.
        """
        count = len(slots)
        reward, discount, action = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.int32)
        observation, next_observation = np.empty((2, count, *self._shape), self._dtype)
        out = _Columns(reward, discount, action, as_bytes(observation), as_bytes(next_observation))
        _unpack(slots, self._ring, as_bytes(frames), out, np.empty(BATCH_ROWS, np.int64))
        columns = {"reward": reward, "discount": discount, "action": action}
        return {**columns, "observation": observation, "next_observation": next_observation}


@kernel
def _unpack(
    slots: NDArray[np.int64], rows: Fields, frames: NDArray[np.uint8], out: _Columns, sources: NDArray[np.int64]
) -> None:
    """Unpacks batches of `len(sources)` slots.

    `sources` is scratch memory: where the next observation of each slot is, slot r as r, frame slot f as -1 - f. The
    middle loop touches all of a batch's next observations before the last loop copies them, so that their cache misses
    overlap.
    """
    capacity, mask, begin = len(rows.row_bytes), len(frames) - 1, rows.offset
    end = begin + frames.shape[1]
    for start in range(0, len(slots), len(sources)):
        batch = range(min(len(sources), len(slots) - start))
        for i in batch:
            slot, ahead = slots[start + i], rows.next_row[slots[start + i]]
            sources[i] = (slot + ahead) % capacity if ahead > 0 else -1 - (-ahead & mask)
            out.reward[start + i], out.discount[start + i] = rows.reward[slot], rows.discount[slot]
            out.action[start + i] = rows.action[slot]
        if begin < end:
            for i in batch:
                source = sources[i]
                out.next_observation[start + i, 0] = (
                    rows.row_bytes[source, begin] if source >= 0 else frames[-1 - source, 0]
                )
        for i in batch:
            source = sources[i]
            copy_bytes(rows.row_bytes[slots[start + i], begin:end], out.observation[start + i], 0)
            if source >= 0:
                copy_bytes(rows.row_bytes[source, begin:end], out.next_observation[start + i], 0)
            else:
                copy_bytes(frames[-1 - source], out.next_observation[start + i], 0)


@inlined
def copy_bytes(source: NDArray[np.uint8], row: NDArray[np.uint8], offset: int) -> None:
    """Copies all of `source` into `row`, from byte `offset` on."""
    target = row[offset : offset + len(source)]
    for i in range(len(source)):
        target[i] = source[i]


@kernel
def renumber_frames(next_row: NDArray[np.int32], first: int) -> None:
    """Adds `first` to the frame numbers that rows hold, in place."""
    for i in range(len(next_row)):
        if next_row[i] <= 0:
            next_row[i] = -((first - next_row[i]) % FRAME_MODULUS)
