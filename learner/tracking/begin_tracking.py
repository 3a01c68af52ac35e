"""Begins the tracking of a run, as early as possible, in the place where it costs least."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Self

from learner.tracking.tracked_run import TrackedRun
from learner.tracking.tracker_process import MlflowProcess, TrackerProcess


class TrackingStart:
    """Loads MLflow in a process of its own (see `learner.tracking.tracker_process`), and opens a store there.

    A process that has MLflow loaded already, such as one that trained before, writes to the store itself. The process
    ends with the `with` block.
    """

    def __init__(self) -> None:
        self._process = None if "mlflow" in sys.modules else MlflowProcess()
        self._run: TrackerProcess | None = None
        self._given: tuple[str, str | None, str | None] = ("", None, None)

    def open(self, uri: str, experiment: str | None, artifact_root: str | None) -> None:
        """Begins to open a store (see `TrackerProcess` for the arguments); returns at once."""
        self._given = uri, experiment, artifact_root
        if self._process is not None:
            self._run = TrackerProcess(self._process, uri, experiment, artifact_root)

    def run(self) -> TrackedRun:
        """The run in the store, neither started nor resumed, once the store is open.

        Raises:
          ConfigError: the store cannot be opened, or the experiment is deleted.
        """
        if self._run is not None:
            self._run.opened()
            return self._run
        from learner.tracking.mlflow_run import Tracker

        return Tracker(*self._given)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        closed = self._run or self._process
        if closed is not None:
            closed.close()
