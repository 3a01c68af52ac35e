"""The log of faults, a file of JSON lines: what failed, what was done about it, and when it recovered."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple

from actors.service.fault_policy import ComponentFailed, Decision, Recovered
from actors.storage.append_file import AppendFile

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
      path: the file; made at the first fault.
      say: shows a line to the user.
    """

    def __init__(self, path: Path, say: Callable[[str], None] = lambda text: None) -> None:
        self._path = path
        self._say = say
        self._file: AppendFile | None = None

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

    def close(self) -> None:
        """Closes the file."""
        if self._file is not None:
            self._file.close()

    def _append(self, event: Event, component: str, fault: str, action: str, attempts: int, seconds: float) -> None:
        entry = FaultEntry(time.time(), event, component, str(fault), str(action), attempts, seconds)
        self._file = self._file or AppendFile(self._path, self._say)
        self._file.append(json.dumps(entry).encode() + b"\n")


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
