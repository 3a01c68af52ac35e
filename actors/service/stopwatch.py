"""Where the time of a part goes, hop by hop."""

from __future__ import annotations

import time
from collections.abc import Callable


class Stopwatch:
    """Sums up seconds by what they were for; every moment after the first counts for one thing.

    Args:
      clock: seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._last_s: float | None = None
        self._seconds: dict[str, float] = {}

    def lap(self, what: str) -> None:
        """The time since the last lap was for `what`; before the first lap the watch stands still."""
        now_s = self._clock()
        if self._last_s is not None:
            self._seconds[what] = self._seconds.get(what, 0.0) + now_s - self._last_s
        self._last_s = now_s

    def take(self) -> dict[str, float]:
        """The seconds by what they were for since the last call."""
        seconds, self._seconds = self._seconds, {}
        return seconds
