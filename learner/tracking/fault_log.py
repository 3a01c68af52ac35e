"""The run's faults as a file of JSON lines: what failed, what was done about it, and when it worked again."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Literal, NamedTuple

from actors.service.fault_policy import ComponentFailed, Decision, Recovered

DRIVER = "driver"
Event = Literal["failed", "mended", "resumed"]


class FaultEntry(NamedTuple):
    """One event: wall time, what happened to which part, and with `mended` how long the part was out."""

    time_s: float
    event: Event
    part: str
    fault: str
    action: str
    attempts: int
    seconds: float


class FaultLog:
    """Appends to the file, one write a line.

    Args:
      path: the file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def failed(self, failure: ComponentFailed, decision: Decision) -> None:
        """Notes a failure and the decision about it."""
        self._append("failed", str(failure.component), failure.fault, decision.action, decision.attempts, 0.0)

    def recovered(self, recovered: Recovered) -> None:
        """Notes that a component works again; the event's name on disk is `mended`."""
        component, fault, action, attempts, seconds = recovered
        self._append("mended", str(component), fault, action, attempts, seconds)

    def resumed(self) -> None:
        """Notes that another driver goes on with the run."""
        self._append("resumed", DRIVER, "died", "resume", 1, 0.0)

    def _append(self, event: Event, part: str, fault: str, action: str, attempts: int, seconds: float) -> None:
        entry = FaultEntry(time.time(), event, part, str(fault), str(action), attempts, seconds)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with self._path.open("a") as file:
            file.write(json.dumps(entry) + "\n")


def read_faults(path: Path) -> list[FaultEntry]:
    """All entries; half a line at the end, of a driver that was killed, does not count."""
    try:
        lines = path.read_text().split("\n")[:-1]
    except OSError:
        return []
    entries = []
    for line in lines:
        try:
            entries.append(FaultEntry(*json.loads(line)))
        except ValueError:
            continue  # a killed driver's half line with the next driver's first behind it
    return entries
