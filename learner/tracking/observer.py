"""Passes what happens in a run to the user, MLflow, Prometheus and the log of faults."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from actors.service.fault_policy import ComponentFailed, Decision, Recovered
from actors.storage.uri import Location
from learner.tracking.delivery import Delivery
from learner.tracking.fault_log import FaultLog
from learner.tracking.journal import Row


class Display(Protocol):
    """Shows a run to the user."""

    def row(self, row: Row) -> None:
        """Shows a row of metrics."""
        ...

    def message(self, text: str) -> None:
        """Shows a line of text."""
        ...


class MirroringObserver:
    """Implements `learner.loop.Observer`: shows everything, has rows delivered to MLflow, and logs faults.

    Args:
      delivery: delivers the journal's rows to MLflow.
      faults: the run's log of faults.
      display: shows the run to the user.
      monitor: exports every row to Prometheus.
      resumed: whether this session resumes the run of an earlier one.
    """

    def __init__(
        self,
        delivery: Delivery,
        faults: FaultLog,
        display: Display,
        monitor: Callable[[Row], None],
        resumed: bool,
    ) -> None:
        self._delivery = delivery
        self._faults = faults
        self._display = display
        self._monitor = monitor
        self._resumed = resumed

    def ready(self) -> None:
        """Logs a resumed run, once its state is restored."""
        if self._resumed:
            self._faults.resumed()

    def row(self, row: Row) -> None:
        """Shows and exports the row."""
        self._display.row(row)
        self._monitor(row)

    def checkpoint(self, folder: Location, journal_offset: int) -> None:
        """Requests the delivery of the rows that the checkpoint covers."""
        self._delivery.deliver_up_to(journal_offset)

    def checkpoint_failed(self, env_steps: int, reason: str) -> None:
        """Shows the reason; the next checkpoint is tried when it is due."""
        self._display.message(f"the checkpoint of {env_steps:,} env steps could not be written: {reason}")

    def failed(self, failure: ComponentFailed, decision: Decision) -> None:
        """Logs and shows a failure."""
        self._faults.failed(failure, decision)
        self._display.message(f"{failure}: {decision.action}")

    def recovered(self, recovered: Recovered) -> None:
        """Logs and shows that a component has recovered."""
        self._faults.recovered(recovered)
        self._display.message(f"{recovered.component} works again after {recovered.seconds:.1f} s")
