"""What a policy expects of the episodes that it plays, beside what it gets: whether it overestimates."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from actors.service.messages import VALUE_DTYPE


class ValueMeter:
    """Adds up values and rewards of greedy episodes that are played together.

    Args:
      values_taken: gives the values `[episodes]` of the actions taken last.
      count: number of episodes.
      discount: per decision.
    """

    def __init__(self, values_taken: Callable[[], NDArray[np.float32]], count: int, discount: float) -> None:
        self._values_taken = values_taken
        self._discount = discount
        self._sums = np.zeros(count, VALUE_DTYPE)
        self._decisions = np.zeros(count)
        self._since_start = 1.0  # discount of this decision's reward in the return from the first state
        self._from_all = 0.0  # the sum of its discounts in the returns from all states so far

    def add(self, reward: NDArray[np.float64], running: NDArray[np.bool_]) -> None:
        """Adds one decision: its reward `[episodes]`, in the episodes that still ran `[episodes]`."""
        value, sums = self._values_taken(), self._sums
        self._from_all = 1.0 + self._discount * self._from_all
        if not self._decisions.any():
            sums["q_start"] = value
        sums["return_start"][running] += self._since_start * reward[running]
        sums["q_visited"][running] += value[running]
        sums["return_visited"][running] += self._from_all * reward[running]
        self._decisions[running] += 1
        self._since_start *= self._discount

    def values(self) -> NDArray[np.void]:
        """VALUE_DTYPE `[episodes]`, once all have ended."""
        found = self._sums.copy()
        for name in ("q_visited", "return_visited"):
            found[name] /= self._decisions
        return found
