"""The processes of a chaos run: the MLflow server, the training command, and its children as victims of faults."""

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
"""Time limit for a process to start, on a busy machine."""
PORTS = range(20_000, 32_768)
"""Above the ports of Ray's workers, below those of outgoing connections: a server that restarts finds its port free."""
TITLES = {
    "rollout worker": ("ray::RolloutNode", "ray::SpareWorker.collect"),
    "replay shard": ("ray::ShardNode", "ray::SpareShard.add", "ray::SpareShard.sample"),
    "learner": ("ray::LearnerActor",),
    "evaluation": ("ray::evaluate",),
    "MLflow process": ("learner.tracking.tracker_process",),
}
"""How a word of the command line of each kind of process begins: Ray's titles, also of a spare that has taken a place,
or a module."""


def free_port() -> int:
    """A port of the loopback interface that is free now."""
    while True:
        port = secrets.choice(PORTS)
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port


class TrackingServer:
    """`mlflow server` on the loopback interface; it can be killed and started again.

    Args:
      folder: the folder of its database, artifacts and log.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._port = free_port()
        self.uri = f"http://127.0.0.1:{self._port}"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Starts the server without waiting for it."""
        command = [sys.executable, "-m", "mlflow", "server", "--host", "127.0.0.1", "--port", str(self._port)]
        command += ["--workers", "1", "--backend-store-uri", f"sqlite:///{self._folder / 'mlflow.db'}"]
        command += ["--artifacts-destination", str(self._folder / "mlartifacts")]
        environment = os.environ | {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}  # saves seven processes
        with (self._folder / "mlflow.log").open("ab") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log, env=environment, start_new_session=True)

    def answers(self) -> bool:
        """Whether the server accepts requests."""
        try:
            with urlopen(f"{self.uri}/health", timeout=2) as reply:
                return bool(reply.status == 200)
        except (URLError, OSError):
            return False

    def wait(self) -> None:
        """Waits until the server answers.

        Raises:
          TimeoutError: it does not within `START_S`.
        """
        end_s = time.monotonic() + START_S
        while not self.answers():
            if time.monotonic() > end_s:
                raise TimeoutError(f"the MLflow server does not start; see {self._folder / 'mlflow.log'}")
            time.sleep(0.2)

    def start_again(self) -> None:
        """Starts the server if it was killed."""
        if self._process is None:
            self.start()

    def kill(self) -> None:
        """Kills the server with its children."""
        if self._process is not None:
            kill_tree(self._process.pid)
            self._process.wait()
            self._process = None


class Driver:
    """`shoal train` or `shoal resume` in the background.

    Args:
      log: file to which its output is appended.
    """

    def __init__(self, log: Path) -> None:
        self._log = log
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, *arguments: str) -> None:
        """Starts `shoal` with the given arguments."""
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "deploy", *arguments],
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def exit_code(self) -> int | None:
        """The exit code; None while the process runs."""
        return None if self._process is None else self._process.poll()

    def children(self, kind: str) -> list[psutil.Process]:
        """The running processes of one kind, ordered by process id; suspended ones are left out."""
        found = []
        for process in _children(self._pid):
            try:
                words = process.cmdline()
            except psutil.Error:
                continue
            if is_of_kind(words, kind) and process.status() != psutil.STATUS_STOPPED:
                found.append(process)
        return sorted(found, key=lambda process: process.pid)

    @property
    def _pid(self) -> int:
        return 0 if self._process is None else self._process.pid

    def kill(self) -> None:
        """Kills the driver alone, as the OOM killer would; Ray's processes then exit by themselves."""
        tree = _children(self._pid)
        os.kill(self._pid, signal.SIGKILL)
        if self._process is not None:
            self._process.wait()
        _, alive = psutil.wait_procs(tree, timeout=10)
        _kill(alive)  # suspended processes do not exit by themselves

    def end(self) -> None:
        """Kills the driver and its descendants, if it still runs."""
        if self.exit_code() is None and self._process is not None:
            kill_tree(self._pid)
            self._process.wait()

    def tail(self, lines: int) -> str:
        """The last lines of the output."""
        return "\n".join(self._log.read_text(errors="replace").splitlines()[-lines:])


def is_of_kind(command_line: list[str], kind: str) -> bool:
    """Whether a process with this command line is of the kind, a key of `TITLES`."""
    return any(word.startswith(TITLES[kind]) for word in command_line)


def fill_disk(process: psutil.Process) -> Callable[[], None]:
    """Makes a process fail when it writes to files, as on a full disk; returns a function that ends this."""
    limits = process.rlimit(psutil.RLIMIT_FSIZE)
    process.rlimit(psutil.RLIMIT_FSIZE, (0, limits[1]))

    def restore() -> None:
        process.rlimit(psutil.RLIMIT_FSIZE, limits)

    return restore


def _children(pid: int) -> list[psutil.Process]:
    try:
        return psutil.Process(pid).children(recursive=True) if pid else []
    except psutil.NoSuchProcess:
        return []


def kill_tree(pid: int) -> None:
    """Kills a process and its descendants."""
    tree = _children(pid)
    try:
        tree.append(psutil.Process(pid))
    except psutil.NoSuchProcess:
        return
    _kill(tree)


def _kill(processes: list[psutil.Process]) -> None:
    for process in processes:
        try:
            process.kill()
        except psutil.NoSuchProcess:
            continue
    psutil.wait_procs(processes, timeout=10)
