"""`shoal chaos`: trains while a seeded schedule kills, freezes and delays processes and fills disks."""

from __future__ import annotations

import random
import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

import psutil
from rich.console import Console
from rich.table import Table

from deploy.chaos.checks import complaints, success
from deploy.chaos.config import CONFIG, NAME, write_config
from deploy.chaos.processes import Driver, TrackingServer, fill_disk
from deploy.options.training import Chaos
from deploy.runs.folders import make_folder
from learner.checkpoints.checkpoint import finished_names
from learner.run_folder import RunFolder
from learner.tracking.fault_log import DRIVER, FaultEntry, read_faults
from learner.tracking.journal import PushedMark
from sim_core.checks import require

POLL_S = 0.1
LOOK_S = 20.0
"""How long to look for a victim of the kind that was drawn, such as an evaluation, before another is drawn."""
FULL_S = 8.0
"""A process finds its disk full for so long, in which a checkpoint is likely to come."""
DELAY_S = 2.0
"""A delayed process is stopped for so long, which is less than the deadline."""
OUTAGE_S = 6.0
"""A killed MLflow server is away for so long."""
MLFLOW = "MLflow server"
FULL = "with a full disk"
PASSING = ("delayed", FULL)
"""What a process recovers from by itself."""


class Kind(NamedTuple):
    """What is done to which process, and how often relative to other kinds."""

    what: str
    victim: str
    weight: int


KINDS = (
    Kind("killed", "rollout worker", 4),
    Kind("killed", "replay shard", 4),
    Kind("killed", "evaluation", 4),
    Kind("killed", "learner", 2),
    Kind("killed", DRIVER, 2),
    Kind("killed", MLFLOW, 2),
    Kind("frozen", "rollout worker", 1),
    Kind("frozen", "replay shard", 1),
    Kind("frozen", "learner", 1),
    Kind("delayed", "rollout worker", 1),
    Kind("delayed", "replay shard", 1),
    Kind("delayed", "learner", 1),
    Kind(FULL, "rollout worker", 1),
    Kind(FULL, "replay shard", 1),
    Kind(FULL, "learner", 1),
)


class Injected(NamedTuple):
    """A fault that was made, and when; `recovery_s` once it is known."""

    kind: Kind
    time_s: float
    recovery_s: float | None = None


class _ChaosRun:
    """The run under attack."""

    def __init__(self, command: Chaos, console: Console) -> None:
        self._command = command
        self._console = console
        self._rng = random.Random(command.seed)
        self.folder = RunFolder(command.out / NAME)
        self.server = TrackingServer(command.out)
        self.driver = Driver(command.out / "driver.log")
        self.injected: list[Injected] = []
        self.outages: list[Injected] = []
        self._server_back_s = 0.0
        self._outage: tuple[float, int] | None = None
        self._undo: list[tuple[float, Callable[[], None]]] = []
        self._setback: set[str] | None = set()
        self._drawn: tuple[Kind, float] | None = None

    def start(self) -> None:
        self.server.start()
        self.server.wait()
        self.driver.start("train", "--config", str(self._command.out / CONFIG), "--name", NAME, *self._flags(True))

    def _flags(self, fresh: bool) -> list[str]:
        place = ["--deadline-s", str(self._command.deadline_s), "--start-deadline-s", "120"]
        tracking = ["--tracking-uri", self.server.uri] if fresh else []
        return ["--runs-dir", str(self._command.out), *tracking, *place]

    def watch(self) -> int:
        """Makes faults until the run ends; returns the exit code of the last driver.

        Raises:
          TimeoutError: the run hangs.
        """
        end_s = time.monotonic() + self._command.limit_s
        next_s = time.monotonic()
        while (code := self.driver.exit_code()) is None or self._outage is not None:
            if time.monotonic() > end_s:
                raise TimeoutError(f"no end after {self._command.limit_s:.0f} s:\n{self.driver.tail(30)}")
            self._undo_what_passed()
            self._mend_server()
            if code is None and time.monotonic() >= next_s and self._may_hurt() and self._hurt():
                next_s = time.monotonic() + self._rng.uniform(0.5, 1.5) * self._command.every_s
            time.sleep(POLL_S)
        return code

    def _checkpoints(self) -> set[str]:
        return set(finished_names(self.folder.checkpoint_location()))

    def _may_hurt(self) -> bool:
        """Not before the first checkpoint, nor before the next one after a setback, so that the run gets on."""
        if len(self.injected) + len(self.outages) >= self._command.faults:
            return False
        if self._setback is None:
            return True
        if not self._checkpoints() - self._setback:
            return False
        self._setback = None
        return True

    def _draw(self) -> Kind:
        """The kind that was drawn last and is still looked for, or another."""
        if self._drawn is None or time.monotonic() > self._drawn[1]:
            kind = self._rng.choices(KINDS, [kind.weight for kind in KINDS])[0]
            self._drawn = (kind, time.monotonic() + LOOK_S)
        return self._drawn[0]

    def _hurt(self) -> bool:
        """Makes one fault; returns whether there was a victim for it."""
        kind, now_s = self._draw(), time.time()
        if kind.victim == MLFLOW:
            if self._outage is not None:
                return False
            self.server.kill()
            self._outage = (now_s, PushedMark.value(self.folder.pushed))
            self._server_back_s = now_s + OUTAGE_S
            self._say(kind)
        elif kind.victim == DRIVER:
            self._kill_driver(kind, now_s)
        else:
            victims = self.driver.children(kind.victim)
            if not victims:
                return False
            self._apply(kind, self._rng.choice(victims))
            self._note(kind, now_s)
        self._drawn = None
        return True

    def _kill_driver(self, kind: Kind, now_s: float) -> None:
        self._setback = self._checkpoints()
        self.driver.kill()
        self._note(kind, now_s)
        self.server.start_again()  # `shoal resume` needs it
        self.server.wait()
        self.driver.start("resume", NAME, *self._flags(False))

    def _apply(self, kind: Kind, victim: psutil.Process) -> None:
        if kind.victim == "learner" and kind.what not in PASSING:
            self._setback = self._checkpoints()
        try:
            if kind.what == "killed":
                victim.kill()
            elif kind.what == FULL:
                self._later(FULL_S, fill_disk(victim))
            else:
                victim.suspend()
        except psutil.NoSuchProcess:
            return
        if kind.what == "delayed":
            self._later(DELAY_S, victim.resume)

    def _later(self, seconds: float, call: Callable[[], None]) -> None:
        self._undo.append((time.monotonic() + seconds, call))

    def _note(self, kind: Kind, time_s: float) -> None:
        self.injected.append(Injected(kind, time_s))
        self._say(kind)

    def _say(self, kind: Kind) -> None:
        self._console.print(f"{kind.victim} {kind.what}", highlight=False)

    def _undo_what_passed(self) -> None:
        due = [item for item in self._undo if item[0] <= time.monotonic()]
        for item in due:
            self._undo.remove(item)
            try:
                item[1]()
            except psutil.NoSuchProcess:
                continue

    def _mend_server(self) -> None:
        if self._outage is None:
            return
        if self._server_back_s and time.time() >= self._server_back_s:
            self._server_back_s = 0.0
            self.server.start_again()
        since_s, mark = self._outage
        if PushedMark.value(self.folder.pushed) > mark or self.driver.exit_code() == 0:
            self.outages.append(Injected(Kind("killed", MLFLOW, 0), since_s, time.time() - since_s))
            self._outage = None

    def end(self) -> None:
        self.driver.end()
        self.server.kill()


def with_recovery(injected: list[Injected], log: list[FaultEntry]) -> list[Injected]:
    """Each fault with the time until its part, or a part that replaced all, worked again; what passes has none."""
    result = []
    for fault in injected:
        if fault.kind.what in PASSING:
            result.append(fault)
            continue
        ends = [entry.time_s for entry in log if entry.time_s > fault.time_s and _ends(fault.kind, entry)]
        result.append(fault._replace(recovery_s=ends[0] - fault.time_s) if ends else fault)
    return result


def _ends(kind: Kind, entry: FaultEntry) -> bool:
    """Whether an entry of the log says that all is well after a fault of this kind."""
    if kind.victim == DRIVER:
        return entry.event == "resumed"
    everything = entry.event == "resumed" or (entry.event == "mended" and entry.part == "learner")
    return everything or (entry.event == "mended" and entry.part.startswith(kind.victim))


def table(faults: list[Injected]) -> Table:
    """Faults, how many of each kind, and how long until the run was whole again."""
    made = Table("fault", "count", "recovery: median, s", "max, s", title="faults of one run")
    for name in sorted({f"{fault.kind.victim} {fault.kind.what}" for fault in faults}):
        same = [fault for fault in faults if f"{fault.kind.victim} {fault.kind.what}" == name]
        times = [fault.recovery_s for fault in same if fault.recovery_s is not None]
        median, longest = (f"{statistics.median(times):.1f}", f"{max(times):.1f}") if times else ("", "")
        made.add_row(name, str(len(same)), median, longest)
    return made


def chaos(command: Chaos) -> int:
    """Runs the whole; returns 0 if the run reached its target and its accounts balance, else 1."""
    require(not (command.out / NAME).exists(), f"{command.out / NAME} exists already; name another --out")
    make_folder(command.out, "--out")
    write_config(command.out / CONFIG, command.env_steps)
    console = Console()
    run = _ChaosRun(command, console)
    try:
        run.start()
        code = run.watch()
        faults = with_recovery(run.injected, read_faults(run.folder.faults)) + run.outages
        wrong = complaints(run.folder) if code == 0 else [f"exit code {code}:\n{run.driver.tail(30)}"]
        learned = success(run.folder) if code == 0 else ""
    except TimeoutError as error:
        faults, wrong, learned = run.injected + run.outages, [str(error)], ""
    finally:
        run.end()
    console.print(table(faults))
    for complaint in wrong:
        console.print(complaint, markup=False, highlight=False, soft_wrap=True)
    if not wrong:
        console.print(f"{len(faults)} faults; target reached, accounts balance, MLflow has every row once")
        console.print(f"success rate {learned}", highlight=False)
    return 1 if wrong else 0
