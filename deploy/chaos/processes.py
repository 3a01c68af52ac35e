"""The processes of a chaos run: an MLflow server, the command that trains, and whom to hurt among its children."""

from __future__ import annotations

import os
import secrets
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from urllib.error import URLError
from urllib.request import urlopen

import psutil

START_S = 180.0
"""How long a process may take to start on a busy machine."""
PORTS = range(20_000, 32_768)
"""Above the ports of Ray's workers, below those of outgoing connections: a server that restarts finds its port free."""
TITLES = {
    "rollout worker": "ray::RolloutNode",
    "replay shard": "ray::ShardNode",
    "learner": "ray::LearnerActor",
    "evaluation": "ray::evaluate",
}
"""How Ray calls the process of each kind of part."""


def free_port() -> int:
    """A port of the loopback interface that is free now."""
    while True:
        port = secrets.choice(PORTS)
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port


class TrackingServer:
    """`mlflow server` on loopback with its database in a folder; may be killed and started again.

    Args:
      folder: where its database, artifacts and log lie.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._port = free_port()
        self.uri = f"http://127.0.0.1:{self._port}"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Starts it; returns at once."""
        command = [sys.executable, "-m", "mlflow", "server", "--host", "127.0.0.1", "--port", str(self._port)]
        command += ["--workers", "1", "--backend-store-uri", f"sqlite:///{self._folder / 'mlflow.db'}"]
        command += ["--artifacts-destination", str(self._folder / "mlartifacts")]
        environment = os.environ | {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}  # seven processes that nobody needs
        with (self._folder / "mlflow.log").open("ab") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log, env=environment, start_new_session=True)

    def answers(self) -> bool:
        """Whether it takes requests."""
        try:
            with urlopen(f"{self.uri}/health", timeout=2) as reply:
                return bool(reply.status == 200)
        except (URLError, OSError):
            return False

    def wait(self) -> None:
        """Waits until it answers.

        Raises:
          TimeoutError: it does not.
        """
        end_s = time.monotonic() + START_S
        while not self.answers():
            if time.monotonic() > end_s:
                raise TimeoutError(f"the MLflow server does not start; see {self._folder / 'mlflow.log'}")
            time.sleep(0.2)

    def start_again(self) -> None:
        """Starts it if it was killed."""
        if self._process is None:
            self.start()

    def kill(self) -> None:
        """Kills it with its children, which are all of its own session."""
        if self._process is not None:
            kill_family(self._process.pid)
            self._process.wait()
            self._process = None


class Driver:
    """`shoal train` or `shoal resume` in the background, its output appended to a log.

    Args:
      log: the file.
    """

    def __init__(self, log: Path) -> None:
        self._log = log
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, *arguments: str) -> None:
        """Starts `shoal` with these arguments."""
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "deploy", *arguments],
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def exit_code(self) -> int | None:
        """Its exit code; None while it runs."""
        return None if self._process is None else self._process.poll()

    def children(self, kind: str) -> list[psutil.Process]:
        """Processes of the run's parts of a kind, in the order of their ids."""
        found = []
        for process in _children(self._pid):
            try:
                words = process.cmdline()
            except psutil.Error:
                continue
            if words and words[0].startswith(TITLES[kind]) and process.status() != psutil.STATUS_STOPPED:
                found.append(process)
        return sorted(found, key=lambda process: process.pid)

    @property
    def _pid(self) -> int:
        return 0 if self._process is None else self._process.pid

    def kill(self) -> None:
        """Kills the driver alone, as an out-of-memory killer would; Ray's processes go with it by themselves."""
        family = _children(self._pid)
        os.kill(self._pid, signal.SIGKILL)
        if self._process is not None:
            self._process.wait()
        _, alive = psutil.wait_procs(family, timeout=10)
        _kill(alive)  # those that were stopped

    def end(self) -> None:
        """Kills all that is left."""
        if self.exit_code() is None and self._process is not None:
            kill_family(self._pid)
            self._process.wait()

    def tail(self, lines: int) -> str:
        """The end of its output."""
        return "\n".join(self._log.read_text(errors="replace").splitlines()[-lines:])


def fill_disk(process: psutil.Process) -> Callable[[], None]:
    """Lets every write of a process to a file fail, as on a full disk; returns what lets it write again."""
    limits = process.rlimit(psutil.RLIMIT_FSIZE)
    process.rlimit(psutil.RLIMIT_FSIZE, (0, limits[1]))

    def empty() -> None:
        process.rlimit(psutil.RLIMIT_FSIZE, limits)

    return empty


def _children(pid: int) -> list[psutil.Process]:
    try:
        return psutil.Process(pid).children(recursive=True) if pid else []
    except psutil.NoSuchProcess:
        return []


def kill_family(pid: int) -> None:
    """Kills a process and all that descend from it."""
    family = _children(pid)
    try:
        family.append(psutil.Process(pid))
    except psutil.NoSuchProcess:
        return
    _kill(family)


def _kill(processes: list[psutil.Process]) -> None:
    for process in processes:
        try:
            process.kill()
        except psutil.NoSuchProcess:
            continue
    psutil.wait_procs(processes, timeout=10)
