"""How a component divides its time between activities."""

from __future__ import annotations

import time
from collections.abc import Callable


class Stopwatch:
    """Sums up seconds per activity; from the first lap on, every moment belongs to exactly one activity.

    Args:
      clock: function that returns seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._last_s: float | None = None
        self._seconds: dict[str, float] = {}

    def lap(self, activity: str) -> None:
        """Adds the time since the last lap to `activity`; the first lap only starts the watch."""
        now_s = self._clock()
        if self._last_s is not None:
            self._seconds[activity] = self._seconds.get(activity, 0.0) + now_s - self._last_s
        self._last_s = now_s

    def take(self) -> dict[str, float]:
        """Returns the seconds per activity since the last call, and resets them."""
        seconds, self._seconds = self._seconds, {}
        return seconds
