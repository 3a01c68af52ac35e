"""The log of faults, a file of JSON lines: what failed, what was done about it, and when it recovered."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Literal, NamedTuple

from actors.service.fault_policy import ComponentFailed, Decision, Recovered

DRIVER = "driver"
Event = Literal["failed", "mended", "resumed"]


class FaultEntry(NamedTuple):
    """One event of a component: wall time in s since the epoch, and for `mended` how many seconds the outage took.

    `attempts` counts the component's failures in a row.
    """

    time_s: float
    event: Event
    component: str
    fault: str
    action: str
    attempts: int
    seconds: float


class FaultLog:
    """Appends to the file, each line in one write.

    Args:
      path: the file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def failed(self, failure: ComponentFailed, decision: Decision) -> None:
        """Records a failure and the decision about it."""
        self._append("failed", str(failure.component), failure.fault, decision.action, decision.attempts, 0.0)

    def recovered(self, recovered: Recovered) -> None:
        """Records that a component has recovered; the event is called `mended` on disk."""
        component, fault, action, attempts, seconds = recovered
        self._append("mended", str(component), fault, action, attempts, seconds)

    def resumed(self) -> None:
        """Records that a new driver has resumed the run."""
        self._append("resumed", DRIVER, "died", "resume", 1, 0.0)

    def _append(self, event: Event, component: str, fault: str, action: str, attempts: int, seconds: float) -> None:
        entry = FaultEntry(time.time(), event, component, str(fault), str(action), attempts, seconds)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with self._path.open("a") as file:
            file.write(json.dumps(entry) + "\n")


def read_faults(path: Path) -> list[FaultEntry]:
    """All entries; a half-written line of a killed driver is skipped."""
    try:
        lines = path.read_text().split("\n")[:-1]
    except OSError:
        return []
    entries = []
    for line in lines:
        try:
            entries.append(FaultEntry(*json.loads(line)))
        except (ValueError, TypeError, RecursionError):
            continue  # a killed driver's half-written line, with the next driver's first line appended
    return entries
