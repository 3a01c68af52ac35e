"""n-step transitions of many environments, a block at a time (Sutton and Barto, 2nd edition, Section 7.1)."""

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

    observation, action: what was seen and done.
    reward: float64.
    reached: the state that the step led to, an ended episode's last where `done`.
    terminated: where the task ended.
    done: where the episode ended, by the task or by the clock.
    """

    observation: NDArray[Any]
    action: NDArray[np.int64]
    reward: NDArray[np.float64]
    reached: NDArray[Any]
    terminated: NDArray[np.bool_]
    done: NDArray[np.bool_]


def _pairs(a: Steps, b: Steps) -> Iterable[tuple[NDArray[Any], NDArray[Any]]]:
    return zip(a, b, strict=True)


def empty_steps(steps: int, num_envs: int, dtype: np.dtype[Any]) -> Steps:
    """Zeroed Steps for rows of `dtype`, packed ones or whole ones."""
    observation = dtype["observation"]
    seen = (steps, num_envs, *observation.shape)
    return Steps(
        observation=np.zeros(seen, observation.base),
        action=np.zeros((steps, num_envs), np.int64),
        reward=np.zeros((steps, num_envs)),
        reached=np.zeros(seen, observation.base),
        terminated=np.zeros((steps, num_envs), np.bool_),
        done=np.zeros((steps, num_envs), np.bool_),
    )


class NStepAssembler:
    """Turns env steps into transitions over `n_step` steps, cut short where an episode ends.

    The last `n_step - 1` steps are kept: those that have not seen `n_step` rewards wait for the next block.

    Args:
      dtype: the packed row (`actors.service.packing.packed_dtype`).
      num_envs: number of environments.
      n_step: steps a transition spans.
      discount: gamma.
    """

    def __init__(self, dtype: np.dtype[Any], num_envs: int, n_step: int, discount: float) -> None:
        self._dtype = dtype
        self._powers = discount ** np.arange(n_step + 1)
        self._kept = empty_steps(n_step - 1, num_envs, dtype)
        self._waits = np.zeros((n_step - 1, num_envs), np.bool_)

    def push(self, steps: Steps) -> Packed:
        """Takes the next env steps and returns the transitions that they complete, oldest first.

        Kept steps that wait are of running episodes, so that every one of them ends in a new step.
        """
        window = self._after_the_kept(steps)
        packed, self._waits = self._complete(window)
        for mine, array in _pairs(self._kept, window):
            mine[...] = array[len(array) - len(mine) :]
        self._kept.done[:] = False  # what waits belongs to running episodes; the rest is of no use any more
        return packed

    def _complete(self, window: Steps) -> tuple[Packed, NDArray[np.bool_]]:
        """The transitions that are complete; and which of the last steps wait."""
        shape = window.done.shape
        rows = np.zeros(window.done.size, self._dtype)
        frames = np.empty((len(rows), *window.reached.shape[2:]), window.reached.dtype)
        columns = _Columns(
            _steps_as_bytes(window.observation), _steps_as_bytes(window.reached), *window[1:3], *window[4:]
        )
        begun = _Begun(np.full(shape, -1), np.empty(len(rows), np.int64))
        waits, fields = np.zeros_like(self._waits), fields_of(rows)
        count = _assemble(columns, self._waits, self._powers, fields, waits, begun)
        kept = _link(columns, fields, as_bytes(frames), begun)
        return Packed(rows[:count], frames[:kept].copy()), waits

    def _after_the_kept(self, steps: Steps) -> Steps:
        if not len(self._waits):
            return steps
        return Steps(*(np.concatenate(pair) for pair in _pairs(self._kept, steps)))

    def clear(self) -> None:
        """Forgets all waiting steps."""
        self._waits[:] = False

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Copies of all that a checkpoint needs."""
        names = ("observation", "action", "reward")
        return {f"kept_{name}": getattr(self._kept, name).copy() for name in names} | {"waits": self._waits.copy()}

    def set_state(self, saved: dict[str, NDArray[Any]]) -> None:
        """Takes up what `get_state` gave."""
        for name in ("observation", "action", "reward"):
            getattr(self._kept, name)[...] = saved[f"kept_{name}"]
        self._waits = saved["waits"].copy()


class _Columns(NamedTuple):
    """Env steps as Steps, observations as bytes `[steps, num_envs, bytes]`, which are the same type of all methods."""

    observation: NDArray[np.uint8]
    reached: NDArray[np.uint8]
    action: NDArray[np.int64]
    reward: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    done: NDArray[np.bool_]


class _Begun(NamedTuple):
    """Of every env step `[steps, num_envs]` the row that begins with it, -1 for none; of every row its last step."""

    row: NDArray[np.int64]
    last: NDArray[np.int64]


def _steps_as_bytes(array: NDArray[Any]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(array).reshape(*array.shape[:2], math.prod(array.shape[2:])).view(np.uint8)


@kernel
def _assemble(
    steps: _Columns,
    waited: NDArray[np.bool_],
    powers: NDArray[np.float64],
    rows: Fields,
    waits: NDArray[np.bool_],
    begun: _Begun,
) -> int:
    """Writes the transitions that are complete to `rows`, and to `waits` which of the last steps are not.

    Of the first steps only those that `waited` begin a transition. `powers` are gamma's up to the n-th.
    """
    total, num_envs = steps.done.shape
    kept, count = len(waits), 0
    for step in range(total):
        for env in range(num_envs):
            if step < kept and not waited[step, env]:
                continue
            value, last, ended = _look_ahead(steps, powers, step, env)
            if not ended and step >= total - kept:
                waits[step - (total - kept), env] = True
                continue
            rows.reward[count] = value
            rows.discount[count] = 0.0 if steps.terminated[last, env] and ended else powers[last + 1 - step]
            rows.action[count] = steps.action[step, env]
            copy_bytes(steps.observation[step, env], rows.memory[count], rows.place)
            begun.row[step, env] = count
            begun.last[count] = last
            count += 1
    return count


@kernel
def _link(steps: _Columns, rows: Fields, frames: NDArray[np.uint8], begun: _Begun) -> int:
    """Writes `next_row`, and to `frames` those that it takes; returns how many these are."""
    total, num_envs = steps.done.shape
    count = 0
    for step in range(total):
        for env in range(num_envs):
            row = begun.row[step, env]
            if row < 0:
                continue
            last = begun.last[row]
            after = -1
            if last + 1 < total and not steps.done[last, env]:
                after = begun.row[last + 1, env]
            if after >= 0:
                rows.next_row[row] = after - row
            else:
                rows.next_row[row] = -count
                copy_bytes(steps.reached[last, env], frames[count], 0)
                count += 1
    return count


@inlined
def _look_ahead(steps: _Columns, powers: NDArray[np.float64], step: int, env: int) -> tuple[float, int, bool]:
    """The discounted rewards from a step on, the last step that they count, and whether the episode ended there."""
    value, last = 0.0, step
    for ahead in range(min(len(powers) - 1, steps.done.shape[0] - step)):
        last = step + ahead
        value += powers[ahead] * steps.reward[last, env]
        if steps.done[last, env]:
            return value, last, True
    return value, last, False
