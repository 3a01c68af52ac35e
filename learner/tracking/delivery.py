"""Delivers journal rows to MLflow in a thread of its own, so that no server can block the training.

Rows that the server does not take are sent again later, in order. The journal's file is the queue: nothing is held in
memory, and the run's next session delivers what this one leaves.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TypeVar

from actors.service.fault_policy import first_line
from actors.storage.full_disk import DISK_TIMEOUT_S, is_disk_full
from learner.tracking.journal import Journal, PushedMark, Row
from learner.tracking.tracked_run import TrackedRun, TrackingError

T = TypeVar("T")

FIRST_PAUSE_S = 1.0
LONGEST_PAUSE_S = 15.0
"""Pauses between two attempts double, from the first to the longest."""
CLOSE_TIMEOUT_S = 1.0
"""How long `Delivery.close` waits for a request in flight."""


class Delivery:
    """Delivers the rows that checkpoints cover.

    Args:
      tracker: the MLflow run.
      journal: the run's journal.
      pushed: remembers how much of it MLflow has.
      say: shows a line to the user.
    """

    def __init__(self, tracker: TrackedRun, journal: Journal, pushed: PushedMark, say: Callable[[str], None]) -> None:
        self._tracker = tracker
        self._journal = journal
        self._pushed = pushed
        self._say = say
        self._requested = pushed.read()
        self._changed = threading.Condition()
        self._closed = False
        self._refused: str | None = None
        self._thread = threading.Thread(target=self._work, name="mlflow-delivery", daemon=True)
        self._thread.start()

    def deliver_up_to(self, offset: int) -> None:
        """Requests the delivery of the rows before byte `offset`; returns at once."""
        with self._changed:
            self._requested = max(self._requested, offset)
            self._changed.notify_all()

    def flush(self, timeout_s: float) -> str | None:
        """Waits until all requested rows are delivered; returns None, or after `timeout_s` the reason they are not."""
        with self._changed:
            self._changed.wait_for(lambda: self._pushed.read() >= self._requested, timeout_s)
            return None if self._pushed.read() >= self._requested else (self._refused or "no answer")

    def close(self) -> None:
        """Ends the delivery. Rows of a request that is still in flight do not count as delivered."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(CLOSE_TIMEOUT_S)

    def _work(self) -> None:
        pause_s = FIRST_PAUSE_S
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._pushed.read() < self._requested)
                if self._closed:
                    return
                end = self._requested
                rows = self._journal.rows(self._pushed.read(), end)
            if self._push(rows, end):
                pause_s = FIRST_PAUSE_S
                continue
            with self._changed:
                self._changed.wait_for(lambda: self._closed, pause_s)
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)

    def _push(self, rows: list[Row], end: int) -> bool:
        """Pushes the rows before byte `end`; returns whether MLflow took them."""
        try:
            self._tracker.push(rows)
            with self._changed:
                if self._closed:
                    return False
                self._pushed.write(end)
                self._changed.notify_all()
        except (TrackingError, OSError) as error:  # OSError: the mark's file cannot be written
            if self._refused is None:
                self._say(f"MLflow does not take the metrics, they are kept and sent again: {first_line(error)}")
            self._refused = first_line(error)
            return False
        if self._refused is not None:
            self._say("MLflow takes the metrics again; none is missing")
        self._refused = None
        return True


def retry(call: Callable[[], T], what: str, timeout_s: float, say: Callable[[str], None]) -> T:
    """Makes a call until neither MLflow nor a full disk refuses it; raises the last error once it has waited too long.

    Args:
      call: the call, which may be repeated.
      what: what it logs or writes, for the message.
      timeout_s: no further attempt begins after this time; after `DISK_TIMEOUT_S` where a disk is full.
      say: shows a line to the user.
    """
    pause_s, start_s = FIRST_PAUSE_S, time.monotonic()
    while True:
        try:
            return call()
        except Exception as error:
            is_full = is_disk_full(error)
            patience_s = DISK_TIMEOUT_S if is_full else timeout_s
            if not (is_full or isinstance(error, TrackingError)) or time.monotonic() + pause_s - start_s > patience_s:
                raise
            reason = "the disk is full, which leaves no room for" if is_full else "MLflow did not take"
            say(f"{reason} {what}, trying again: {first_line(error)}")
            time.sleep(pause_s)
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
