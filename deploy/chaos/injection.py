"""Trains a run while a seeded schedule kills, freezes and delays its processes and fills their disks."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from typing import NamedTuple

import psutil
from rich.console import Console

from deploy.chaos.config import CONFIG, NAME
from deploy.chaos.faults import DELAYED, FULL, KILLED, KINDS, MLFLOW, TRACKER, TRANSIENT, FaultKind, InjectedFault
from deploy.chaos.processes import Driver, TrackingServer, fill_disk
from deploy.options.training import Chaos
from learner.checkpoints.checkpoint import finished_names
from learner.run_folder import RunFolder
from learner.tracking.fault_log import DRIVER
from learner.tracking.journal import PushedMark

POLL_S = 0.1
SEARCH_S = 20.0
"""How long a victim of the drawn kind is searched for, such as an evaluation, before another kind is drawn."""
FULL_S = 8.0
"""Duration of a full disk, in which a checkpoint is likely to be due."""
DELAY_S = 2.0
"""Duration of a delay; shorter than the deadline, so that the component is not replaced."""
OUTAGE_S = 6.0
"""Time after which a killed MLflow server is started again."""


class _Outage(NamedTuple):
    """An outage of MLflow: the fault, how much of the journal MLflow had, and the processes that wrote to it."""

    fault: InjectedFault
    mark: int
    writers: list[psutil.Process]


class ChaosRun:
    """A training under fault injection.

    Args:
      command: the options.
      console: where each fault is printed.

    Attributes:
      folder: the run.
      server: its MLflow server.
      driver: the process of `shoal train` or `shoal resume`.
      injected: faults of the run's processes so far.
      outages: finished outages of the MLflow server, or of the process that writes to it, with their recovery times.
    """

    def __init__(self, command: Chaos, console: Console) -> None:
        self._command = command
        self._console = console
        self._rng = random.Random(command.seed)
        self.folder = RunFolder(command.out / NAME)
        self.server = TrackingServer(command.out)
        self.driver = Driver(command.out / "driver.log")
        self.injected: list[InjectedFault] = []
        self.outages: list[InjectedFault] = []
        self._server_back_s = 0.0
        self._outage: _Outage | None = None
        self._pending_ends: list[tuple[float, Callable[[], None]]] = []
        self._checkpoints_at_setback: set[str] | None = set()
        self._drawn: tuple[FaultKind, float] | None = None

    def start(self) -> None:
        """Starts the MLflow server and the training."""
        self.server.start()
        self.server.wait()
        self.driver.start("train", "--config", str(self._command.out / CONFIG), "--name", NAME, *self._flags(True))

    def _flags(self, fresh: bool) -> list[str]:
        deadlines = ["--deadline-s", str(self._command.deadline_s), "--start-deadline-s", "120"]
        tracking = ["--tracking-uri", self.server.uri] if fresh else []
        spares = ["--spares", str(self._command.spares)]
        return ["--runs-dir", str(self._command.out), *tracking, *deadlines, *spares]

    def inject_until_end(self) -> int:
        """Injects faults until the training ends; returns the exit code of the last driver.

        Raises:
          TimeoutError: the training hangs.
        """
        end_s = time.monotonic() + self._command.limit_s
        next_s = time.monotonic()
        while (code := self.driver.exit_code()) is None:
            if time.monotonic() > end_s:
                raise TimeoutError(f"no end after {self._command.limit_s:.0f} s:\n{self.driver.tail(30)}")
            self._end_transient_faults()
            self._follow_outage()
            if time.monotonic() >= next_s and self._may_inject() and self._inject():
                next_s = time.monotonic() + self._rng.uniform(0.5, 1.5) * self._command.every_s
            time.sleep(POLL_S)
        if self._outage is not None:  # the run ended first
            self.outages.append(self._outage.fault)
        self.server.start_again()  # what it has is checked next
        self.server.wait()
        return code

    def _checkpoints(self) -> set[str]:
        return set(finished_names(self.folder.checkpoint_location()))

    def _may_inject(self) -> bool:
        """False before the first checkpoint, and after a setback before the next one, so that the run advances."""
        if len(self.injected) + len(self.outages) + (self._outage is not None) >= self._command.faults:
            return False
        if self._checkpoints_at_setback is None:
            return True
        if not self._checkpoints() - self._checkpoints_at_setback:
            return False
        self._checkpoints_at_setback = None
        return True

    def _draw(self) -> FaultKind:
        """The last drawn kind while a victim is searched for, else a new one."""
        if self._drawn is None or time.monotonic() > self._drawn[1]:
            kinds = [kind for kind in KINDS if self._outage is None or kind.victim not in (MLFLOW, TRACKER)]
            kind = self._rng.choices(kinds, [kind.weight for kind in kinds])[0]
            self._drawn = (kind, time.monotonic() + SEARCH_S)
        return self._drawn[0]

    def _inject(self) -> bool:
        """Injects one fault; returns whether there was a victim."""
        kind, now_s = self._draw(), time.time()
        if kind.victim in (MLFLOW, TRACKER):
            if not self._cut_off_mlflow(kind, now_s):
                return False
        elif kind.victim == DRIVER:
            self._kill_driver(kind, now_s)
        else:
            victims = self.driver.children(kind.victim)
            if not victims:
                return False
            if not self._apply(kind, self._rng.choice(victims)):
                return False
            self._record(kind, now_s)
        self._drawn = None
        return True

    def _cut_off_mlflow(self, kind: FaultKind, now_s: float) -> bool:
        """Kills the MLflow server, or the process that writes to it; returns whether there was one to kill."""
        mark, writers = PushedMark.value(self.folder.pushed), self.driver.children(TRACKER)
        if kind.victim == MLFLOW:
            self.server.kill()
            self._server_back_s = now_s + OUTAGE_S
        elif not writers or not self._apply(kind, writers[0]):
            return False
        self._outage = _Outage(InjectedFault(kind, now_s), mark, writers)
        self._print(kind)
        return True

    def _kill_driver(self, kind: FaultKind, now_s: float) -> None:
        self._checkpoints_at_setback = self._checkpoints()
        self.driver.kill()
        self._record(kind, now_s)
        self.server.start_again()  # `shoal resume` needs it
        self.server.wait()
        self.driver.start("resume", NAME, *self._flags(False))

    def _apply(self, kind: FaultKind, victim: psutil.Process) -> bool:
        """Does to a process what the kind says; returns whether it was still there."""
        if kind.victim == "learner" and kind.action not in TRANSIENT:
            self._checkpoints_at_setback = self._checkpoints()
        try:
            if kind.action == KILLED:
                victim.kill()
            elif kind.action == FULL:
                self._schedule(FULL_S, fill_disk(victim))
            else:
                victim.suspend()
        except psutil.NoSuchProcess:
            return False
        if kind.action == DELAYED:
            self._schedule(DELAY_S, victim.resume)
        return True

    def _schedule(self, seconds: float, call: Callable[[], None]) -> None:
        self._pending_ends.append((time.monotonic() + seconds, call))

    def _record(self, kind: FaultKind, time_s: float) -> None:
        self.injected.append(InjectedFault(kind, time_s))
        self._print(kind)

    def _print(self, kind: FaultKind) -> None:
        self._console.print(f"{kind.victim} {kind.action}")

    def _end_transient_faults(self) -> None:
        due = [item for item in self._pending_ends if item[0] <= time.monotonic()]
        for item in due:
            self._pending_ends.remove(item)
            try:
                item[1]()
            except psutil.NoSuchProcess:
                continue

    def _follow_outage(self) -> None:
        """Restarts a killed MLflow server in time; an outage ends once a checkpoint's rows are delivered."""
        if self._outage is None:
            return
        if self._server_back_s and time.time() >= self._server_back_s:
            self._server_back_s = 0.0
            self.server.start_again()
        fault, mark, writers = self._outage
        if PushedMark.value(self.folder.pushed) <= mark:
            return
        if fault.kind.victim == MLFLOW or self.driver.children(TRACKER) not in ([], writers):
            self.outages.append(fault._replace(recovery_s=time.time() - fault.time_s))
            self._outage = None

    def end(self) -> None:
        """Kills the processes that are left."""
        self.driver.end()
        self.server.kill()
