"""Transitions without repeats: an observation that a later row begins with is not stored a second time.

What a transition led to is, n steps later, what another one of the same environment began with. A packed row therefore
names the row that it led to by its distance. Observations that no row begins with, an episode's last ones and those
of steps that come with a later block, are kept beside the rows, as frames.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_core.jit import inlined, kernel

NUMBERS = 2**31
"""Frames are known by their number among all that came, modulo this."""


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
    """Layout of a packed row of such transitions (`actors.transitions.transition_dtype`)."""
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
    size = array.dtype.itemsize * int(np.prod(array.shape[1:]))
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


def unpack(slots: NDArray[np.int64], rows: NDArray[Any], frames: NDArray[Any], into: np.dtype[Any]) -> NDArray[Any]:
    """Whole transitions.

    Args:
      slots: which rows `[count]`.
      rows: a ring of packed rows.
      frames: frame k stands at k modulo their number, a power of 2.
      into: the transitions' layout (`actors.transitions.transition_dtype`).
    """
    out: NDArray[Any] = np.zeros(len(slots), into)  # padding too: it travels, and is compared
    packed, fields = rows.dtype.fields, into.fields
    assert packed is not None and fields is not None
    assert all(packed[name][1] == fields[name][1] < packed["next_row"][1] for name in ("reward", "discount", "action"))
    places = (packed["next_row"][1], packed["observation"][1], fields["observation"][1], fields["next_observation"][1])
    _unpack(slots, as_bytes(rows), rows["next_row"], as_bytes(frames), places, as_bytes(out))
    return out


@kernel
def _unpack(
    slots: NDArray[np.int64],
    rows: NDArray[np.uint8],
    next_row: NDArray[np.int32],
    frames: NDArray[np.uint8],
    places: tuple[int, int, int, int],
    out: NDArray[np.uint8],
) -> None:
    """`places`: where a packed row's `next_row` and observation begin, and a whole one's two observations."""
    head, seen, seen_out, reached_out = places
    capacity, mask, size = len(rows), len(frames) - 1, frames.shape[1]
    for i in range(len(slots)):
        row = rows[slots[i]]
        copy_bytes(row[:head], out[i], 0)
        copy_bytes(row[seen : seen + size], out[i], seen_out)
        ahead = next_row[slots[i]]
        if ahead > 0:
            copy_bytes(rows[(slots[i] + ahead) % capacity][seen : seen + size], out[i], reached_out)
        else:
            copy_bytes(frames[-ahead & mask], out[i], reached_out)


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
