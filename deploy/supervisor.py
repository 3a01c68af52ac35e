"""`shoal train --supervise`: a small process that runs the driver, and starts it again when it has been killed.

The command line puts this process in its own place, so that it imports next to nothing. It tells a driver that was
killed from one that ended: an exit code of any kind is the end, and is passed on. What is left of a killed driver is
killed, too, before the next one resumes the run. A driver that is killed twice without progress is given up.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import NamedTuple, NoReturn

import psutil

from learner.file_names import END, END_STATE, JOURNAL
from learner.own_processes import STOPPING, module_order

RESUMES: tuple[str, ...] = ("--or-resume", "True")
PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36
"""Of Linux's prctl."""
GONE_S = 10.0
"""How long processes take to be gone after SIGKILL, at most."""
FAILED, SIGNALLED = 1, 128


class Reached(NamedTuple):
    """How far a run is: steps of its end that are made, and env steps of its last row of metrics."""

    end_steps: int
    env_steps: int


def reached(run: Path) -> Reached:
    """How far the run in the folder `run` is."""
    made, env_steps = 0, 0
    with suppress(OSError, ValueError, KeyError):
        made = 1 + len(json.loads((run / END / END_STATE).read_text("utf-8"))["made"])
    with suppress(OSError, ValueError, KeyError, IndexError):
        whole = (run / JOURNAL).read_bytes().rpartition(b"\n")[0]
        env_steps = int(json.loads(whole.rpartition(b"\n")[2])[0])
    return Reached(made, env_steps)


class Supervisor:
    """Runs the driver of one run until the run has ended.

    Args:
      run: the run's folder.
      order: the command line of the first driver; RESUMES follows in those after it.
    """

    def __init__(self, run: Path, order: Sequence[str]) -> None:
        self._run = run
        self._order = list(order)
        self._driver: subprocess.Popen[bytes] | None = None
        self._passed_on = 0

    def supervise(self) -> int:
        """Runs drivers until one ends by itself, or makes no progress; returns the exit code."""
        _prctl(PR_SET_CHILD_SUBREAPER, 1)  # what a killed driver leaves becomes a child of this process
        for number in STOPPING:  # the driver has a process group of its own, so a terminal sends them here alone
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:  # as nohup wants it
                signal.signal(number, self._pass_on)
        best, resumes = Reached(0, -1), tuple[str, ...]()
        while True:
            code = self._run_driver([*self._order, *resumes])
            if code >= 0:
                return code
            _kill_children()
            if self._passed_on:  # before it had a handler, or because it took too long
                return SIGNALLED + self._passed_on
            now = reached(self._run)
            where = f"the driver was killed by {signal.Signals(-code).name} at {now.env_steps:,} env steps"
            if now <= best:
                _say(f"{where}, again without progress; find the cause, then `shoal resume {self._run}`")
                return FAILED
            _say(f"{where}; going on with the run")
            best = now
            resumes = RESUMES

    def _run_driver(self, order: list[str]) -> int:
        """Runs a driver to its end; returns its exit code, or the negative number of the signal that killed it."""
        self._driver = subprocess.Popen(order, process_group=0, preexec_fn=_end_with_parent)
        if self._passed_on:
            self._driver.send_signal(self._passed_on)  # it arrived between two drivers
        while self._driver.poll() is None:
            with suppress(ChildProcessError):
                os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOWAIT)  # orphans of the driver end here, too
            _reap(but=self._driver.pid)
        return self._driver.returncode

    def _pass_on(self, number: int, frame: FrameType | None) -> None:
        self._passed_on = self._passed_on or number
        if self._driver is not None and self._driver.returncode is None:
            with suppress(ProcessLookupError):
                self._driver.send_signal(number)


def _prctl(option: int, value: int) -> None:
    ctypes.CDLL(None, use_errno=True).prctl(option, value, 0, 0, 0)


def _end_with_parent() -> None:
    """Has this process get SIGTERM when its parent ends: a supervisor that is killed leaves no driver behind."""
    _prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


def _reap(but: int = 0) -> None:
    """Takes the exit codes of children that have ended, except that of `but`."""
    for child in psutil.Process().children():
        with suppress(psutil.NoSuchProcess, ChildProcessError):
            if child.pid != but and child.status() == psutil.STATUS_ZOMBIE:
                os.waitpid(child.pid, os.WNOHANG)


def _kill_children() -> None:
    """Kills all that a driver left behind: it must not write to the run's folder any more."""
    end_s = time.monotonic() + GONE_S
    while (left := psutil.Process().children(recursive=True)) and time.monotonic() < end_s:
        for process in left:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        psutil.wait_procs(left, timeout=1.0)
        _reap()


def _say(text: str) -> None:
    with suppress(OSError):
        os.write(2, f"shoal: {text}\n".encode())


def take_over(run: Path, arguments: Sequence[str]) -> NoReturn:
    """Replaces this process by the supervisor of a run.

    Args:
      run: the run's folder.
      arguments: those of `shoal` that start the run, without `--supervise`.
    """
    sys.stdout.flush()
    os.execv(sys.executable, module_order("deploy.supervisor", [str(run), *arguments]))


if __name__ == "__main__":
    sys.exit(Supervisor(Path(sys.argv[1]), module_order("deploy", sys.argv[2:])).supervise())
