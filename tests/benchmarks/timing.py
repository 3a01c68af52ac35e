"""Interleaved timing: several rivals in turn in one run, so that ratios hold while the machine drifts."""

import statistics
import time
from collections.abc import Callable
from typing import NamedTuple


class Spread(NamedTuple):
    """Lowest, median and highest of several measurements."""

    low: float
    median: float
    high: float

    def text(self, digits: int = 0) -> str:
        return f"{self.median:,.{digits}f} ({self.low:,.{digits}f} … {self.high:,.{digits}f})"


def spread(values: list[float]) -> Spread:
    return Spread(min(values), statistics.median(values), max(values))


def rates(rivals: dict[str, Callable[[], int]], rounds: int) -> dict[str, list[float]]:
    """Units of work a second of each rival, once a round, in turn; a first round warms up."""
    found: dict[str, list[float]] = {name: [] for name in rivals}
    for i in range(rounds + 1):
        for name, work in rivals.items():
            start_s = time.perf_counter()
            units = work()
            elapsed_s = time.perf_counter() - start_s
            if i:
                found[name].append(units / elapsed_s)
    return found


def ratio(ours: list[float], theirs: list[float]) -> Spread:
    """Ours over theirs, round by round."""
    return spread([a / b for a, b in zip(ours, theirs, strict=True)])
