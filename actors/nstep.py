"""n-step transitions of many environments at once (Sutton and Barto, 2nd edition, Section 7.1)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


class NStepAssembler:
    """Turns env steps into transitions over `n_step` steps, cut short where an episode ends.

    Steps that have not seen `n_step` rewards wait here, per environment, oldest first.

    Args:
      dtype: the row (`actors.transitions.transition_dtype`).
      num_envs: number of environments.
      n_step: steps a transition spans.
      discount: gamma.
    """

    def __init__(self, dtype: np.dtype[Any], num_envs: int, n_step: int, discount: float) -> None:
        self._n_step = n_step
        self._discount = discount
        self._powers = discount ** np.arange(n_step + 1)
        self._waiting = np.zeros((n_step, num_envs), dtype)
        self._returns = np.zeros((n_step, num_envs), np.float64)
        self._count = np.zeros(num_envs, np.int64)
        self._envs = np.arange(num_envs)

    def push(
        self,
        observation: NDArray[Any],
        action: NDArray[np.int64],
        reward: NDArray[np.floating],
        next_observation: NDArray[Any],
        terminated: NDArray[np.bool_],
        done: NDArray[np.bool_],
    ) -> list[NDArray[Any]]:
        """Takes one step of every environment and returns the transitions that it completes.

        Args:
          observation, action: what was seen and done, `[num_envs, ...]`.
          reward: `[num_envs]`.
          next_observation: the state reached, the ended episode's last where `done`.
          terminated: where the task ended, `[num_envs]`.
          done: where the episode ended, by the task or by the clock, `[num_envs]`.

        Returns:
          Arrays of rows, oldest transitions first.
        """
        slot = self._count
        self._waiting["observation"][slot, self._envs] = observation
        self._waiting["action"][slot, self._envs] = action
        self._returns[slot, self._envs] = 0.0
        self._count = self._count + 1
        for age in range(self._n_step):
            waits = age < self._count
            weight = self._powers[np.maximum(self._count - 1 - age, 0)]
            self._returns[age] += np.where(waits, weight * reward, 0.0)
        completed = []
        for age in range(self._n_step):
            leaves = (done & (age < self._count)) | ((age == 0) & (self._count == self._n_step))
            if leaves.any():
                completed.append(self._take(age, leaves, next_observation, terminated))
        self._shift(done)
        return completed

    def _take(
        self, age: int, leaves: NDArray[np.bool_], next_observation: NDArray[Any], terminated: NDArray[np.bool_]
    ) -> NDArray[Any]:
        rows: NDArray[Any] = self._waiting[age, leaves]
        rows["reward"] = self._returns[age, leaves]
        span = self._count[leaves] - age
        rows["discount"] = np.where(terminated[leaves], 0.0, self._powers[span])
        rows["next_observation"] = next_observation[leaves]
        return rows

    def _shift(self, done: NDArray[np.bool_]) -> None:
        self._count[done] = 0
        full = self._count == self._n_step
        if full.any():
            self._waiting[:-1, full] = self._waiting[1:, full]
            self._returns[:-1, full] = self._returns[1:, full]
            self._count[full] -= 1

    def clear(self) -> None:
        """Forgets all waiting steps."""
        self._count[:] = 0

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Copies of all that a checkpoint needs."""
        fields = {f"waiting_{name}": self._waiting[name].copy() for name in ("observation", "action")}
        return fields | {"returns": self._returns.copy(), "count": self._count.copy()}

    def set_state(self, saved: dict[str, NDArray[Any]]) -> None:
        """Takes up what `get_state` gave."""
        for name in ("observation", "action"):
            self._waiting[name] = saved[f"waiting_{name}"]
        self._returns[...] = saved["returns"]
        self._count = saved["count"].copy()
