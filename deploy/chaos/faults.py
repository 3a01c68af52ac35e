"""The faults of `shoal chaos`, and how long a run takes to recover from each."""

from __future__ import annotations

import statistics
from typing import NamedTuple

from rich.table import Table

from learner.tracking.fault_log import DRIVER, FaultEntry

MLFLOW, TRACKER = "MLflow server", "MLflow process"
"""The server, and the process of the run that writes to it."""
KILLED, FROZEN, DELAYED, FULL = "killed", "frozen", "delayed", "with a full disk"
TRANSIENT = (DELAYED, FULL)
"""Actions that end by themselves; the process is not replaced."""


class FaultKind(NamedTuple):
    """An action on one kind of process, and its relative frequency."""

    action: str
    victim: str
    weight: int


KINDS = (
    FaultKind(KILLED, "rollout worker", 4),
    FaultKind(KILLED, "replay shard", 4),
    FaultKind(KILLED, "evaluation", 4),
    FaultKind(KILLED, "learner", 2),
    FaultKind(KILLED, DRIVER, 2),
    FaultKind(KILLED, MLFLOW, 2),
    FaultKind(KILLED, TRACKER, 2),
    FaultKind(FROZEN, "rollout worker", 1),
    FaultKind(FROZEN, "replay shard", 1),
    FaultKind(FROZEN, "learner", 1),
    FaultKind(DELAYED, "rollout worker", 1),
    FaultKind(DELAYED, "replay shard", 1),
    FaultKind(DELAYED, "learner", 1),
    FaultKind(FULL, "rollout worker", 1),
    FaultKind(FULL, "replay shard", 1),
    FaultKind(FULL, "learner", 1),
)


class InjectedFault(NamedTuple):
    """A fault, its time (seconds since the epoch), and its recovery time once it is known."""

    kind: FaultKind
    time_s: float
    recovery_s: float | None = None


def with_recovery(injected: list[InjectedFault], log: list[FaultEntry]) -> list[InjectedFault]:
    """The faults with their recovery times: until the component, or the whole run, works again.

    Transient faults, and those from which the run never recovered, have none.
    """
    result = []
    for fault in injected:
        if fault.kind.action in TRANSIENT:
            result.append(fault)
            continue
        ends = [entry.time_s for entry in log if entry.time_s > fault.time_s and _ends(fault.kind, entry)]
        result.append(fault._replace(recovery_s=ends[0] - fault.time_s) if ends else fault)
    return result


def _ends(kind: FaultKind, entry: FaultEntry) -> bool:
    """Whether an entry of the fault log reports recovery from this kind of fault."""
    if kind.victim == DRIVER:
        return entry.event == "resumed"
    all_rebuilt = entry.event == "resumed" or (entry.event == "mended" and entry.component == "learner")
    return all_rebuilt or (entry.event == "mended" and entry.component.startswith(kind.victim))


def fault_table(faults: list[InjectedFault]) -> Table:
    """The number of faults of each kind, with median and maximum of their recovery times."""
    table = Table("fault", "count", "recovery: median, s", "max, s", title="faults of one run")
    for name in sorted({f"{fault.kind.victim} {fault.kind.action}" for fault in faults}):
        same = [fault for fault in faults if f"{fault.kind.victim} {fault.kind.action}" == name]
        times = [fault.recovery_s for fault in same if fault.recovery_s is not None]
        median, longest = (f"{statistics.median(times):.1f}", f"{max(times):.1f}") if times else ("", "")
        table.add_row(name, str(len(same)), median, longest)
    return table
