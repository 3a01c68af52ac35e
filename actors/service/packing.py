"""Transitions without repeats: an observation that a later row begins with is not stored a second time.

What a transition led to is, n steps later, what another one of the same environment began with. A packed row therefore
names the row that it led to by its distance. Observations that no row begins with, an episode's last ones and those
of steps that come with a later block, are kept beside the rows, as frames.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_core.jit import inlined, kernel

NUMBERS = 2**31
"""Frames are known by their number among all that came, modulo this."""

PART = 16
"""Rows that are unpacked together: about as many reads as a core has under way at once."""


class Packed(NamedTuple):
    """Transitions, oldest first.

    rows: of `packed_dtype`; a positive `next_row` is the distance to the row that begins with what this one led to,
      any other, negated, the number of the frame that it led to. These numbers count from 0, along the rows.
    frames: what rows led to and no row begins with `[frames, *shape]`.
    """

    rows: NDArray[Any]
    frames: NDArray[Any]

    def is_sound(self, row: np.dtype[Any]) -> bool:
        """Whether the rows have this layout, and lead to rows among them and to all of the frames in turn."""
        observation = row["observation"]
        frame = self.frames.dtype, self.frames.shape[1:]
        if self.rows.dtype != row or frame != (observation.base, observation.shape):
            return False
        return leads(self.rows["next_row"], range(len(self.frames)))


def packed_dtype(transition: np.dtype[Any]) -> np.dtype[Any]:
    """Layout of a packed row of such transitions (`actors.service.messages.transition_dtype`)."""
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


def frames_of(transitions: int, steps_per_block: int, n_step: int) -> int:
    """Frames that so many transitions lead to after a block's last steps; those of ended episodes come on top."""
    return transitions * min(n_step, steps_per_block) // steps_per_block


def as_bytes(array: NDArray[Any]) -> NDArray[np.uint8]:
    """An array's entries as bytes `[len(array), bytes]`, the same memory where it is contiguous."""
    size = array.dtype.itemsize * math.prod(array.shape[1:])
    return np.ascontiguousarray(array).view(np.uint8).reshape(len(array), size)


def leads(next_row: NDArray[np.int32], frames: range) -> bool:
    """Whether rows, oldest first, lead to rows among them and to all frames of these numbers in turn."""
    return bool(_leads(next_row, frames.start, frames.stop))


@kernel
def _leads(next_row: NDArray[np.int32], first: int, after: int) -> bool:
    for i in range(len(next_row)):
        if next_row[i] > 0:
            if i + next_row[i] >= len(next_row):
                return False
        else:
            if first == after or -next_row[i] != first % NUMBERS:
                return False
            first += 1
    return first == after


def count_frames(rows: NDArray[Any]) -> int:
    """How many frames packed rows refer to."""
    return int(np.count_nonzero(rows["next_row"] <= 0))


class Fields(NamedTuple):
    """The fields of packed rows, the rows as bytes `[rows, bytes]`, and where in these the observation begins."""

    reward: NDArray[np.float32]
    discount: NDArray[np.float32]
    action: NDArray[np.int32]
    next_row: NDArray[np.int32]
    memory: NDArray[np.uint8]
    place: int


def fields_of(rows: NDArray[Any]) -> Fields:
    """Views of packed rows, for kernels: the same types whatever is observed."""
    fields = rows.dtype.fields
    assert fields is not None
    place = fields["observation"][1]
    return Fields(rows["reward"], rows["discount"], rows["action"], rows["next_row"], as_bytes(rows), place)


class _Drawn(NamedTuple):
    """Columns of whole transitions, observations as bytes."""

    reward: NDArray[np.float32]
    discount: NDArray[np.float32]
    action: NDArray[np.int32]
    observation: NDArray[np.uint8]
    next_observation: NDArray[np.uint8]


class Unpacker:
    """Makes whole transitions of a ring of packed rows.

    Args:
      rows: the ring, whose memory is looked at in every call.
    """

    def __init__(self, rows: NDArray[Any]) -> None:
        observation = rows.dtype["observation"]
        self._ring = fields_of(rows)
        self._shape, self._dtype = observation.shape, observation.base

    def __call__(self, slots: NDArray[np.int64], frames: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Columns of whole transitions `[count, ...]`, by the names of `messages.transition_dtype`.

        Args:
          slots: which rows `[count]`.
          frames: frame k stands at k modulo their number, a power of 2.
        """
        count = len(slots)
        reward, discount, action = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.int32)
        seen, reached = np.empty((2, count, *self._shape), self._dtype)
        drawn = _Drawn(reward, discount, action, as_bytes(seen), as_bytes(reached))
        _unpack(slots, self._ring, as_bytes(frames), drawn, np.empty(PART, np.int64))
        columns = {"reward": reward, "discount": discount, "action": action}
        return {**columns, "observation": seen, "next_observation": reached}


@kernel
def _unpack(
    slots: NDArray[np.int64], rows: Fields, frames: NDArray[np.uint8], out: _Drawn, reached: NDArray[np.int64]
) -> None:
    """Part after part of the slots, of the length of `reached`, whose reads are under way at once."""
    capacity, mask, begin = len(rows.memory), len(frames) - 1, rows.place
    end = begin + frames.shape[1]
    for start in range(0, len(slots), len(reached)):
        part = range(min(len(reached), len(slots) - start))
        for i in part:
            slot, ahead = slots[start + i], rows.next_row[slots[start + i]]
            reached[i] = (slot + ahead) % capacity if ahead > 0 else -1 - (-ahead & mask)
            out.reward[start + i], out.discount[start + i] = rows.reward[slot], rows.discount[slot]
            out.action[start + i] = rows.action[slot]
        if begin < end:
            for i in part:
                place = reached[i]
                out.next_observation[start + i, 0] = rows.memory[place, begin] if place >= 0 else frames[-1 - place, 0]
        for i in part:
            place = reached[i]
            copy_bytes(rows.memory[slots[start + i], begin:end], out.observation[start + i], 0)
            if place >= 0:
                copy_bytes(rows.memory[place, begin:end], out.next_observation[start + i], 0)
            else:
                copy_bytes(frames[-1 - place], out.next_observation[start + i], 0)


@inlined
def copy_bytes(source: NDArray[np.uint8], row: NDArray[np.uint8], place: int) -> None:
    """Writes all of `source` to a row, from byte `place` on."""
    target = row[place : place + len(source)]
    for i in range(len(source)):
        target[i] = source[i]


@kernel
def renumber(next_row: NDArray[np.int32], first: int) -> None:
    """Adds `first` to the number of every frame that rows refer to, in place."""
    for i in range(len(next_row)):
        if next_row[i] <= 0:
            next_row[i] = -((first - next_row[i]) % NUMBERS)
