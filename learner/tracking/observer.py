"""Who is told of a run: a person, MLflow, Prometheus and the log of faults."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from actors.service.fault_policy import ComponentFailed, Decision, Recovered
from actors.storage.uri import Location
from learner.tracking.delivery import Delivery
from learner.tracking.fault_log import FaultLog
from learner.tracking.journal import Row


class Display(Protocol):
    """What shows a run to a person."""

    def row(self, row: Row) -> None:
        """A row of metrics was written."""
        ...

    def message(self, text: str) -> None:
        """Something worth a line happened."""
        ...


class MirroringObserver:
    """Passes rows on to the display, to MLflow once a checkpoint covers them, and faults to their log.

    Args:
      delivery: carries the journal to MLflow.
      faults: the run's log of faults.
      display: shows all to a person.
      monitor: is given every row too.
      resumed: whether this process goes on with the run of another one.
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
        """Logs that the run is where another process left it."""
        if self._resumed:
            self._faults.resumed()

    def row(self, row: Row) -> None:
        """Shows the row."""
        self._display.row(row)
        self._monitor(row)

    def checkpoint(self, folder: Location, journal_offset: int) -> None:
        """Asks for the delivery of the rows that the checkpoint covers."""
        self._delivery.up_to(journal_offset)

    def checkpoint_failed(self, env_steps: int, reason: str) -> None:
        """Says so; the next checkpoint is tried as usual."""
        self._display.message(f"the checkpoint of {env_steps:,} env steps could not be written: {reason}")

    def failed(self, failure: ComponentFailed, decision: Decision) -> None:
        """Logs and shows a failure."""
        self._faults.failed(failure, decision)
        self._display.message(f"{failure}: {decision.action}")

    def recovered(self, recovered: Recovered) -> None:
        """Logs and shows that a component works again."""
        self._faults.recovered(recovered)
        self._display.message(f"{recovered.component} works again after {recovered.seconds:.1f} s")
