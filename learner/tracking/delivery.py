"""Carries journal rows to MLflow in a thread of its own, so that no server can hold up the training.

What the server does not take is kept and sent later, in order. The journal's file is the queue: nothing is
held in memory, and what a process leaves undelivered the next sitting delivers.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from actors.service.fault_policy import first_line
from learner.tracking.journal import Journal, PushedMark, Row
from learner.tracking.mlflow_run import TROUBLE, Tracker

FIRST_PAUSE_S = 1.0
LONGEST_PAUSE_S = 15.0
LAST_WAIT_S = 1.0
"""Pauses between two attempts double from the first to the longest."""


class Delivery:
    """Pushes the rows that checkpoints cover.

    Args:
      tracker: the MLflow run.
      journal: the run's journal.
      pushed: remembers how much of it MLflow has.
      say: shows a line to a person.
    """

    def __init__(self, tracker: Tracker, journal: Journal, pushed: PushedMark, say: Callable[[str], None]) -> None:
        self._tracker = tracker
        self._journal = journal
        self._pushed = pushed
        self._say = say
        self._wanted = pushed.read()
        self._changed = threading.Condition()
        self._closed = False
        self._refused: str | None = None
        self._thread = threading.Thread(target=self._work, name="mlflow-delivery", daemon=True)
        self._thread.start()

    def up_to(self, offset: int) -> None:
        """Asks for the rows before byte `offset`; returns at once."""
        with self._changed:
            self._wanted = max(self._wanted, offset)
            self._changed.notify_all()

    def flush(self, patience_s: float) -> str | None:
        """Waits until all rows asked for are delivered; after `patience_s`, returns why they are not."""
        with self._changed:
            self._changed.wait_for(lambda: self._pushed.read() >= self._wanted, patience_s)
            return None if self._pushed.read() >= self._wanted else (self._refused or "no answer")

    def close(self) -> None:
        """Ends the delivery; what a request that is still under way brings no longer counts as delivered."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(LAST_WAIT_S)

    def _work(self) -> None:
        pause_s = FIRST_PAUSE_S
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._pushed.read() < self._wanted)
                if self._closed:
                    return
                wanted = self._wanted
                rows = self._journal.rows(self._pushed.read(), wanted)
            if self._push(rows, wanted):
                pause_s = FIRST_PAUSE_S
                continue
            with self._changed:
                self._changed.wait_for(lambda: self._closed, pause_s)
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)

    def _push(self, rows: list[Row], offset: int) -> bool:
        try:
            self._tracker.push(rows)
            with self._changed:
                if self._closed:
                    return False
                self._pushed.write(offset)
                self._changed.notify_all()
        except (*TROUBLE, OSError) as error:  # the mark is a file
            if self._refused is None:
                self._say(f"MLflow does not take the metrics, they are kept and sent again: {first_line(error)}")
            self._refused = first_line(error)
            return False
        if self._refused is not None:
            self._say("MLflow takes the metrics again; none is missing")
        self._refused = None
        return True


def insist(call: Callable[[], None], what: str, patience_s: float, say: Callable[[str], None]) -> None:
    """Makes a call of MLflow's until it works; once `patience_s` have passed its error comes out."""
    pause_s, give_up_s = FIRST_PAUSE_S, time.monotonic() + patience_s
    while True:
        try:
            return call()
        except TROUBLE as error:
            if time.monotonic() + pause_s > give_up_s:
                raise
            say(f"MLflow did not take {what}, trying again: {first_line(error)}")
            time.sleep(pause_s)
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
