"""n-step transitions of many environments, assembled block by block (Sutton and Barto, 2nd edition, Section 7.1)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.service.packing import Fields, Packed, as_bytes, copy_bytes, fields_of
from sim_core.jit import inlined, kernel


class Steps(NamedTuple):
    """Consecutive env steps of many environments, each array `[steps, num_envs, ...]`.

    observation, action: the observation and the action taken in it.
    reward: float64.
    next_observation: observation after the step; an episode's last one where `done`. It is read there and in the last
      step alone: elsewhere it is the next step's observation.
    terminated: where the task terminated.
    done: where the episode ended, terminated or truncated.
    decided: where there was a step; a learning robot whose episode has ended makes none until its world restarts.
    """

    observation: NDArray[Any]
    action: NDArray[np.int64]
    reward: NDArray[np.float64]
    next_observation: NDArray[Any]
    terminated: NDArray[np.bool_]
    done: NDArray[np.bool_]
    decided: NDArray[np.bool_]


def _pairs(a: Steps, b: Steps) -> Iterable[tuple[NDArray[Any], NDArray[Any]]]:
    return zip(a, b, strict=True)


def empty_steps(steps: int, num_envs: int, dtype: np.dtype[Any]) -> Steps:
    """Zeroed Steps; `dtype` is that of a transition or of a packed row, and gives the observations' shape and dtype."""
    observation = dtype["observation"]
    shape = (steps, num_envs, *observation.shape)
    return Steps(
        observation=np.zeros(shape, observation.base),
        action=np.zeros((steps, num_envs), np.int64),
        reward=np.zeros((steps, num_envs)),
        next_observation=np.zeros(shape, observation.base),
        terminated=np.zeros((steps, num_envs), np.bool_),
        done=np.zeros((steps, num_envs), np.bool_),
        decided=np.ones((steps, num_envs), np.bool_),
    )


class NStepAssembler:
    """Turns env steps into n-step transitions, which are shorter where an episode ends.

    Each environment, or learning robot of one, has a chain of transitions of its own.

    The last `n_step - 1` steps are kept. Those without `n_step` rewards are pending: the next block completes them.

    Args:
      dtype: structured dtype of a packed row (`actors.service.packing.packed_dtype`).
      num_envs: number of environments.
      n_step: steps per transition.
      discount: gamma.
    """

    def __init__(self, dtype: np.dtype[Any], num_envs: int, n_step: int, discount: float) -> None:
        self._dtype = dtype
        self._powers = discount ** np.arange(n_step + 1)
        self._kept = empty_steps(n_step - 1, num_envs, dtype)
        self._pending = np.zeros((n_step - 1, num_envs), np.bool_)
        self._window, self._room = empty_steps(n_step - 1, num_envs, dtype), empty_steps(0, num_envs, dtype)

    def room(self, steps: int) -> Steps:
        """Memory for the next `steps` env steps, to be filled and pushed: other Steps are copied when they are pushed.

        It is kept from block to block, since memory that is new takes longer to write to.
        """
        if len(self._room.done) != steps:
            kept = len(self._pending)
            self._window = empty_steps(kept + steps, self._pending.shape[1], self._dtype)
            columns: list[NDArray[Any]] = [array[kept:] for array in self._window]
            self._room = Steps(*columns)
        return self._room

    def push(self, steps: Steps) -> Packed:
        """Takes the next env steps and returns the transitions that they complete, oldest first.

        Pending steps belong to running episodes, so that each of their transitions ends in a new step.
        """
        window = self._with_kept(steps)
        packed, self._pending = self._complete(window)
        for kept, array in _pairs(self._kept, window):
            kept[...] = array[len(array) - len(kept) :]
        self._kept.done[:] = False  # pending steps belong to running episodes; the others are not used again
        self._kept.decided[:] = True
        return packed

    def _complete(self, window: Steps) -> tuple[Packed, NDArray[np.bool_]]:
        """Returns the complete transitions, and which of the last `n_step - 1` steps are pending."""
        shape = window.done.shape
        rows = np.zeros(window.done.size, self._dtype)
        frames = np.empty((len(rows), *window.next_observation.shape[2:]), window.next_observation.dtype)
        columns = _Columns(
            _steps_as_bytes(window.observation), _steps_as_bytes(window.next_observation), *window[1:3], *window[4:]
        )
        index = _RowIndex(np.full(shape, -1), np.empty(len(rows), np.int64))
        pending, fields = np.zeros_like(self._pending), fields_of(rows)
        num_rows = _assemble(columns, self._pending, self._powers, fields, pending, index)
        num_frames = _link(columns, fields, as_bytes(frames), index)
        return Packed(rows[:num_rows], frames[:num_frames].copy()), pending

    def _with_kept(self, steps: Steps) -> Steps:
        room = self.room(len(steps.done))
        if steps is not room:
            for own, array in _pairs(room, steps):
                own[...] = array
        for array, kept in _pairs(self._window, self._kept):
            array[: len(kept)] = kept
        return self._window

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Copies of everything that a checkpoint needs."""
        names = ("observation", "action", "reward")
        return {f"kept_{name}": getattr(self._kept, name).copy() for name in names} | {"waits": self._pending.copy()}

    def set_state(self, saved: dict[str, NDArray[Any]]) -> None:
        """Restores a `get_state`."""
        for name in ("observation", "action", "reward"):
            getattr(self._kept, name)[...] = saved[f"kept_{name}"]
        self._pending = saved["waits"].copy()


class _Columns(NamedTuple):
    """Steps with observations as bytes `[steps, num_envs, bytes]`, so that kernels compile once for all methods."""

    observation: NDArray[np.uint8]
    next_observation: NDArray[np.uint8]
    action: NDArray[np.int64]
    reward: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    done: NDArray[np.bool_]
    decided: NDArray[np.bool_]


class _RowIndex(NamedTuple):
    """Which row starts at which step.

    `row` `[steps, num_envs]`: the row that starts at an env step, -1 if there is none. `last` `[rows]`: the last step
    that a row counts.
    """

    row: NDArray[np.int64]
    last: NDArray[np.int64]


def _steps_as_bytes(array: NDArray[Any]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(array).reshape(*array.shape[:2], math.prod(array.shape[2:])).view(np.uint8)


@kernel
def _assemble(
    steps: _Columns,
    was_pending: NDArray[np.bool_],
    powers: NDArray[np.float64],
    rows: Fields,
    pending: NDArray[np.bool_],
    index: _RowIndex,
) -> int:
    """Writes the complete transitions to `rows` and `index`; returns their number.

    Args:
      steps: the kept steps and the new ones.
      was_pending: which of the kept steps start a transition `[n_step - 1, num_envs]`.
      powers: gamma^0 to gamma^n.
      rows: written; all fields but `next_row`.
      pending: written; which of the last steps are not complete yet `[n_step - 1, num_envs]`.
      index: written.
    """
    total, num_envs = steps.done.shape
    kept, count = len(pending), 0
    for step in range(total):
        for env in range(num_envs):
            if not steps.decided[step, env] or (step < kept and not was_pending[step, env]):
                continue
            value, last, ended = _n_step_return(steps, powers, step, env)
            if not ended and step >= total - kept:
                pending[step - (total - kept), env] = True
                continue
            rows.reward[count] = value
            rows.discount[count] = 0.0 if steps.terminated[last, env] and ended else powers[last + 1 - step]
            rows.action[count] = steps.action[step, env]
            copy_bytes(steps.observation[step, env], rows.row_bytes[count], rows.offset)
            index.row[step, env] = count
            index.last[count] = last
            count += 1
    return count


@kernel
def _link(steps: _Columns, rows: Fields, frames: NDArray[np.uint8], index: _RowIndex) -> int:
    """Writes `next_row` of all rows, and the frames that they refer to; returns the number of frames."""
    total, num_envs = steps.done.shape
    count = 0
    for step in range(total):
        for env in range(num_envs):
            row = index.row[step, env]
            if row < 0:
                continue
            last = index.last[row]
            after = -1
            if last + 1 < total and not steps.done[last, env]:
                after = index.row[last + 1, env]
            if after >= 0:
                rows.next_row[row] = after - row
            else:
                rows.next_row[row] = -count
                if last + 1 < total and not steps.done[last, env]:
                    copy_bytes(steps.observation[last + 1, env], frames[count], 0)
                else:
                    copy_bytes(steps.next_observation[last, env], frames[count], 0)
                count += 1
    return count


@inlined
def _n_step_return(steps: _Columns, powers: NDArray[np.float64], step: int, env: int) -> tuple[float, int, bool]:
    """(n-step return from `step` on, the last step that it counts, whether the episode ended there)."""
    value, last = 0.0, step
    for ahead in range(min(len(powers) - 1, steps.done.shape[0] - step)):
        last = step + ahead
        value += powers[ahead] * steps.reward[last, env]
        if steps.done[last, env]:
            return value, last, True
    return value, last, False
