"""Interleaved timing: several rivals in turn in one run, so that ratios hold while the machine drifts."""

import os
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from sim_core.worlds import WorldBatch


class Spread(NamedTuple):
    """Lowest, median and highest of several measurements."""

    low: float
    median: float
    high: float

    def text(self, digits: int = 0) -> str:
        return f"{self.median:,.{digits}f} ({self.low:,.{digits}f} … {self.high:,.{digits}f})"


class Timed(NamedTuple):
    """Work that was done and the time that counts for it."""

    units: int
    seconds: float


def spread(values: list[float]) -> Spread:
    return Spread(min(values), statistics.median(values), max(values))


def rates(rivals: dict[str, Callable[[], int]], rounds: int) -> dict[str, list[float]]:
    """Units of work a second of each rival, once a round, in turn; a first round warms up."""
    return timed_rates({name: stopwatch(work) for name, work in rivals.items()}, rounds)


def sustained(work: Callable[[], int], seconds: float) -> Callable[[], int]:
    """`work` again and again for so many seconds, so that a core's turns and pauses are in the mean."""

    def repeated() -> int:
        end_s, units = time.perf_counter() + seconds, 0
        while time.perf_counter() < end_s:
            units += work()
        return units

    return repeated


def timed_rates(rivals: dict[str, Callable[[], Timed]], rounds: int) -> dict[str, list[float]]:
    """As `rates`, for rivals that hold the watch themselves."""
    found: dict[str, list[float]] = {name: [] for name in rivals}
    for i in range(rounds + 1):
        for name, work in rivals.items():
            units, seconds = work()
            if i:
                found[name].append(units / seconds)
    return found


def stopwatch(work: Callable[[], int], clock: Callable[[], float] = time.perf_counter) -> Callable[[], Timed]:
    """`work` with the time of the whole call; `time.process_time` leaves out what other processes take from it."""

    def timed() -> Timed:
        start_s = clock()
        units = work()
        return Timed(units, clock() - start_s)

    return timed


def ratio(ours: list[float], theirs: list[float]) -> Spread:
    """Ours over theirs, round by round."""
    return spread([a / b for a, b in zip(ours, theirs, strict=True)])


def seconds_of_steps(worlds: WorldBatch, start: dict[str, Any], steps: int) -> float:
    """Seconds of `steps` env steps of all worlds under FL-ORCA from the state `start`; setting it is not timed."""
    worlds.set_state(start)
    start_s = time.perf_counter()
    for _ in range(steps):
        worlds.swarm_step()
    return time.perf_counter() - start_s


@contextmanager
def pinned(core: int) -> Iterator[None]:
    """Keeps this thread, and child processes that it starts, on one core within the `with` block."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
