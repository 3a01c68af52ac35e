"""The processes of a training over Ray, by what they do."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import psutil

from deploy.chaos.processes import TITLES, is_of_kind

SPY, IDLE = "profiler", "idle worker of Ray"


def kind_of(process: psutil.Process) -> str:
    """What a process of the run's does."""
    words = process.cmdline() or [process.name()]
    if Path(words[0]).name == "py-spy":
        return SPY
    for kind in TITLES:
        if is_of_kind(words, kind):
            return kind
    if words[0].startswith("ray::IDLE"):
        return IDLE
    return next((name for name in ("raylet", "gcs_server") if name in words[0]), "other process of Ray")


def processes_of_the_run() -> Iterator[tuple[str, psutil.Process]]:
    """This process, the driver, and its children, each with what it does; those that look at others are left out."""
    driver = psutil.Process()
    yield "driver", driver
    for process in driver.children(recursive=True):
        try:
            kind = kind_of(process)
        except psutil.NoSuchProcess:
            continue
        if kind != SPY:
            yield kind, process


def by_kind(look: Callable[[psutil.Process], Sequence[float]]) -> dict[str, np.ndarray]:
    """What `look` sees of this process, the driver, and of its children, summed over the processes of each kind."""
    sums: dict[str, np.ndarray] = {}
    for kind, process in processes_of_the_run():
        try:
            with process.oneshot():
                seen = np.array(look(process), float)
        except psutil.NoSuchProcess:
            continue
        sums[kind] = sums.get(kind, 0.0) + seen
    return sums


def cpu_seconds() -> dict[str, float]:
    """CPU time spent so far, by kind of process."""
    return {kind: float(times.sum()) for kind, times in by_kind(lambda process: process.cpu_times()[:2]).items()}
