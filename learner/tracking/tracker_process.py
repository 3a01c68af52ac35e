"""A run in MLflow, written by a process of its own: MLflow loads while this process does the rest of a run's start.

MLflow takes more than a second to import, and its export of a policy's network seconds more. The process does both
beside this one, on another core. Calls go through a socket and are numbered, so that several can be under way, from
several threads. The process ends with the one that started it, however that one ends. If it dies before, the next call
starts another one, which goes on with the run.
"""

from __future__ import annotations

import itertools
import os
import signal
import socket
import subprocess
import sys
import threading
import traceback
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from learner.own_processes import STOPPING, collect_rarely, module_order
from learner.tracking.tracked_run import TrackedRun, TrackingError
from sim_core.checks import ConfigError

if TYPE_CHECKING:
    from actors.policy.policy import WeightsSnapshot
    from actors.rollout.vector_env import EnvShape
    from learner.config import RunConfig
    from learner.tracking.journal import Row
    from learner.tracking.mlflow_run import Tracker

OPEN, LOAD_END = "open", "load_end"
"""The calls that make the process's tracker, and that load what it needs at the end; all others are the tracker's."""
ENDS_S = 5.0
"""How long the process may take to end."""


class ProcessGone(Exception):
    """The process has died."""


class MlflowProcess:
    """A process that loads MLflow, and calls of a `Tracker` in it.

    Attributes:
      pid: id of the process.
    """

    def __init__(self) -> None:
        self._socket, theirs = socket.socketpair()
        with theirs:
            # In a process group of its own, which a terminal does not send its signals to.
            self._process = subprocess.Popen(
                module_order("learner.tracking.tracker_process", [str(theirs.fileno())]),
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                process_group=0,
            )
        self.pid = self._process.pid
        self._connection: Connection[Any, Any] = Connection(os.dup(self._socket.fileno()))
        self._numbers = itertools.count()
        self._lock = threading.Lock()
        self._waiting: dict[int, Future[Any]] = {}
        self._is_gone = False
        self._reader = threading.Thread(target=self._read, name="mlflow-replies", daemon=True)
        self._reader.start()

    def begin(self, name: str, *arguments: object) -> Future[Any]:
        """Sends a call; the future gives its result, or raises its error, or ProcessGone."""
        future = Future[Any]()
        with self._lock:
            number = next(self._numbers)
            try:
                if self._is_gone:
                    raise BrokenPipeError
                self._connection.send((number, name, arguments))
                self._waiting[number] = future
            except OSError:
                future.set_exception(ProcessGone())
        return future

    def _read(self) -> None:
        """Hands each reply to who waits for it, until the process has gone."""
        with suppress(EOFError, OSError):
            while True:
                number, result, error = self._connection.recv()
                with self._lock:
                    future = self._waiting.pop(number)
                if error is None:
                    future.set_result(result)
                else:
                    future.set_exception(error)
        with self._lock:
            self._is_gone = True
            self._connection.close()
            waiting, self._waiting = self._waiting, {}
        for future in waiting.values():
            future.set_exception(ProcessGone())

    def close(self) -> None:
        """Ends the process; calls under way are given up."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._reader.join()
        self._socket.close()
        try:
            self._process.wait(ENDS_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class TrackerProcess(TrackedRun):
    """One MLflow run, written by a process of its own (see TrackedRun); begins to open its store.

    Args:
      process: where MLflow is loaded, or loads; another one takes its place if it dies.
      uri: tracking URI.
      experiment: experiment name; created if missing. None for a run that is resumed, which has one.
      artifact_root: where a new experiment stores its artifacts, None for the server's default.
    """

    def __init__(self, process: MlflowProcess, uri: str, experiment: str | None, artifact_root: str | None) -> None:
        super().__init__(uri)
        self._process = process
        self._lock = threading.Lock()
        self._opening = process.begin(OPEN, uri, experiment, artifact_root)

    @property
    def pid(self) -> int:
        """Id of the present process."""
        return self._process.pid

    def opened(self) -> None:
        """Waits until the store is open.

        Raises:
          ConfigError: it cannot be opened, or the experiment is deleted.
        """
        try:
            self._opening.result()
        except ProcessGone as error:
            raise ConfigError(
                "the process that writes to MLflow has died; free some memory, then start again"
            ) from error

    def _call(self, name: str, *arguments: object) -> Any:
        """Makes a call that may be repeated: where its process dies, in another one.

        Raises:
          TrackingError: the store fails, or two processes have died.
        """
        process = self._process
        try:
            return process.begin(name, *arguments).result()
        except ProcessGone:
            pass
        try:
            return self._successor(process).begin(name, *arguments).result()
        except ProcessGone as error:
            raise TrackingError("the process that writes to MLflow has died twice") from error

    def _successor(self, dead: MlflowProcess) -> MlflowProcess:
        """The process in the place of one that has died; has the store open and knows the run."""
        with self._lock:
            if self._process is dead:
                dead.close()
                self._process = MlflowProcess()
                try:
                    self._process.begin(OPEN, self.uri, None, None).result()
                    if self.run_id:
                        self._process.begin("rejoin", self.run_id).result()
                except BaseException as error:  # also Ctrl-C: a process that does not know the run must not stay
                    self._process.close()
                    if isinstance(error, ConfigError):
                        raise TrackingError(str(error)) from error
                    raise
            return self._process

    def start(self, config: RunConfig) -> None:
        """See TrackedRun; not repeated, since that would make a second run."""
        try:
            self._process.begin("start", config).result()
        except ProcessGone as error:
            raise TrackingError("the process that writes to MLflow has died") from error
        self._take_identity()

    def resume(self, run_id: str) -> None:
        """See TrackedRun."""
        self._call("resume", run_id)
        self._take_identity()

    def _take_identity(self) -> None:
        self.run_id, self.started_ms = self._call("run_id"), self._call("started_ms")

    def is_finished(self, run_id: str) -> bool:
        """See TrackedRun."""
        return bool(self._call("is_finished", run_id))

    def push(self, rows: list[Row]) -> None:
        """See TrackedRun."""
        self._call("push", rows)

    def log_results(self, metrics: dict[str, float], time_ms: int) -> None:
        """See TrackedRun."""
        self._call("log_results", metrics, time_ms)

    def log_artifact(self, path: Path) -> None:
        """See TrackedRun."""
        self._call("log_artifact", path.absolute())

    def attach(self, run_id: str, path: Path, place: str) -> None:
        """See TrackedRun."""
        self._call("attach", run_id, path.absolute(), place)

    def load_end(self) -> None:
        """See TrackedRun."""
        self._process.begin(LOAD_END)

    def begin_policy(self, weights: WeightsSnapshot, config: RunConfig, shape: EnvShape) -> None:
        """See TrackedRun."""
        self._process.begin("log_network", weights, config, shape)

    def log_policy(self, weights: WeightsSnapshot, config: RunConfig, shape: EnvShape, score: float) -> None:
        """See TrackedRun."""
        self._call("log_policy", weights, config, shape, score)

    def end(self, status: str) -> None:
        """See TrackedRun."""
        self._call("end", status)

    def close(self) -> None:
        """Ends the process."""
        self._process.close()


class _Desk:
    """Answers calls in the process.

    Args:
      connection: to the process that calls.
    """

    def __init__(self, connection: Connection[Any, Any]) -> None:
        self._connection = connection
        self._sending = threading.Lock()
        self._tracker: Tracker | None = None

    def answer(self, number: int, name: str, arguments: tuple[Any, ...]) -> None:
        """Makes a call and sends its result, or its error: of other kinds than ours only the text."""
        result: Any = None
        error: Exception | None = None
        try:
            result = self._do(name, arguments)
        except (ConfigError, TrackingError, OSError) as raised:
            error = raised
        except Exception:
            error = RuntimeError(traceback.format_exc())
        with self._sending, suppress(OSError):  # who asked may have gone
            self._connection.send((number, result, error))

    def _do(self, name: str, arguments: tuple[Any, ...]) -> Any:
        from learner.tracking import mlflow_run  # here, since it imports MLflow

        if name == OPEN:
            self._tracker = mlflow_run.Tracker(*arguments)
            return None
        if name == LOAD_END:
            return mlflow_run.load(mlflow_run.END_MODULES)
        found = getattr(self._tracker, name)
        return found(*arguments) if callable(found) else found


def _load_stores() -> None:
    from learner.tracking import mlflow_run  # here, since it imports MLflow

    mlflow_run.load(mlflow_run.STORE_MODULES)


def _serve(connection: Connection[Any, Any]) -> None:
    """Answers calls, each in a thread, until the other process has closed the connection, or has died.

    What stops a run does not stop this process: the run's last rows and its end go through it.
    """
    for number in STOPPING:
        signal.signal(number, signal.SIG_IGN)
    collect_rarely()
    desk, pool = _Desk(connection), ThreadPoolExecutor()
    pool.submit(_load_stores)
    with suppress(EOFError, OSError):
        while True:
            pool.submit(desk.answer, *connection.recv())
    os._exit(0)  # at once: nobody waits for what is under way


if __name__ == "__main__":
    _serve(Connection(int(sys.argv[1])))
