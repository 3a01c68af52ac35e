"""Runs a search: asks its study for trials, computes their objectives, logs each as a run of one MLflow experiment."""

from __future__ import annotations

import functools
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from actors.service.fault_policy import first_line
from deploy.runs.objectives import Objective, ObjectiveError, values_of
from learner.run_folder import RunFolder
from learner.search.config import SearchConfig
from learner.search.space import Value
from learner.search.study import SearchStudy
from learner.search.trial import Progress, read_result, run_trial
from learner.sweep.cell import SweepLocation
from learner.tracking.mlflow_run import Tracker
from learner.tracking.redaction import hide_secrets
from learner.tracking.tracked_run import TrackingError
from sim_core.checks import ConfigError

TRIALS, CELLS, TRACE = "trials", "cells", "error.txt"
"""In a search's folder: the trials' folders; in a trial's: its cells' folders, and the traceback of its last crash."""


class SearchPlace(NamedTuple):
    """Where a search is stored and logged: its folder, the MLflow tracking URI and the experiment of its trials."""

    folder: Path
    tracking_uri: str
    experiment: str

    @property
    def cells_experiment(self) -> str:
        """The experiment of the trainings within the trials."""
        return f"{self.experiment} cells"

    def trial_name(self, number: int) -> str:
        """Name of a trial's folder and MLflow run."""
        return f"{self.folder.name}-{number:04d}"

    def trial(self, number: int) -> SweepLocation:
        """Where a trial's cells are stored and logged; the episodes that judge them rank no registered model."""
        folder = self.folder / TRIALS / self.trial_name(number) / CELLS
        return SweepLocation(folder, self.tracking_uri, self.cells_experiment, registers=False)


def work(
    search: SearchConfig,
    place: SearchPlace,
    number: int,
    settings: dict[str, Value],
    report: Callable[[dict[str, Any]], None],
) -> None:
    """What a trial does in its own process; see `learner.sweep.tune.Work`."""
    run_trial(search, settings, place.trial(number), lambda progress: report(progress._asdict()))


class TrialListener(Protocol):
    """Hears of a search's trials."""

    def started(self, number: int) -> None:
        """A trial has started."""
        ...

    def ended(self, number: int) -> None:
        """A trial has ended; the study's record says how."""
        ...

    def message(self, text: str) -> None:
        """A line for the user."""
        ...


class SearchDriver:
    """The source of a search's trials; implements `learner.sweep.tune.TrialSource`.

    Args:
      search: the search.
      objectives: what it optimises.
      study: its trials.
      place: where it is stored and logged.
      listener: hears of trials.
    """

    def __init__(
        self,
        search: SearchConfig,
        objectives: list[Objective],
        study: SearchStudy,
        place: SearchPlace,
        listener: TrialListener,
    ) -> None:
        self._search = search
        self._objectives = objectives
        self._study = study
        self._place = place
        self._listener = listener
        self._settings: dict[int, dict[str, Value]] = {}
        self._twins: dict[int, list[int]] = {}
        self._trackers: dict[int, Tracker] = {}

    def next(self) -> tuple[int, dict[str, Any]] | None:
        """The next trial that has something to run.

        Not run are settings that contradict each other, which fail with the reason; and settings that another trial has
        had or has, whose values they take.
        """
        while (asked := self._study.ask()) is not None:
            number, settings = asked
            running = [other for other, its in self._settings.items() if its == settings]
            known = [each for each in self._study.records() if each.state == "complete" and each.settings == settings]
            self._settings[number] = settings
            self._in_mlflow(functools.partial(self._tracker, number))
            self._listener.started(number)
            if running:
                self._twins.setdefault(running[0], []).append(number)
            elif known:
                self._complete(number, list(known[0].values))
            elif self._is_possible(number, settings):
                return number, settings
        return None

    def _is_possible(self, number: int, settings: dict[str, Value]) -> bool:
        try:
            self._search.cells(settings)
            return True
        except ConfigError as error:
            self._fail(number, str(error))
            return False

    def progressed(self, number: int, progress: dict[str, Any]) -> bool:
        """Whether a trial goes on: it ends where its success is in the worse half, if the search prunes."""
        found = Progress(**progress)
        if not self._search.prune or found.part is None:
            return True
        return not self._study.must_end(number, found.part, found.success)

    def finished(self, number: int) -> None:
        """Computes the objectives; a trial without them fails, and the search goes on."""
        settings = self._settings[number]
        _, cells = self._search.cells(settings)
        try:
            result = read_result(number, settings, cells, self._place.trial(number).cells)
            self._complete(number, values_of(self._objectives, result))
        except ObjectiveError as error:
            self._fail(number, str(error))

    def stopped(self, number: int) -> None:
        """Ends the trial's MLflow runs, and removes the checkpoints of its training."""
        location = self._place.trial(number)
        for cell in self._search.cells(self._settings[number])[1]:
            shutil.rmtree(RunFolder(location.cells / cell.key).checkpoints, ignore_errors=True)
            self._in_mlflow(functools.partial(_end_cell, location, cell.key))
        self._end(number, "KILLED", {}, self._study.pruned)

    def failed(self, number: int, trace: str) -> None:
        """Writes the traceback to the trial's folder, and stores its last line."""
        path = self._place.folder / TRIALS / self._place.trial_name(number) / TRACE
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(trace + "\n")
        lines = [line.strip() for line in trace.splitlines() if line.strip()]
        self._fail(number, f"{lines[-1]} (trace in {path})")

    def _complete(self, number: int, values: list[float]) -> None:
        metrics = {objective.name: value for objective, value in zip(self._objectives, values, strict=True)}
        self._end(number, "FINISHED", metrics, lambda ended: self._study.complete(ended, values))

    def _fail(self, number: int, reason: str) -> None:
        self._end(number, "FAILED", {}, lambda ended: self._study.fail(ended, reason))

    def _end(self, number: int, status: str, metrics: dict[str, float], store: Callable[[int], None]) -> None:
        """Stores how a trial ended, and the same for its twins, once MLflow has it: what is not stored is run again."""
        self._in_mlflow(lambda: self._end_run(number, status, metrics))
        store(number)
        del self._settings[number]
        self._listener.ended(number)
        for twin in self._twins.pop(number, []):
            self._end(twin, status, metrics, store)

    def _end_run(self, number: int, status: str, metrics: dict[str, float]) -> None:
        tracker = self._tracker(number)
        tracker.log_results({_metric_name(name): value for name, value in metrics.items()}, tracker.started_ms)
        tracker.end(status)
        del self._trackers[number]

    def _tracker(self, number: int) -> Tracker:
        """The trial's MLflow run: that of an earlier session, which its tags tell, or a new one."""
        if number not in self._trackers:
            tracker = Tracker(self._place.tracking_uri, self._place.experiment, None)
            tags = {"search": self._place.folder.name, "trial": str(number)}
            known = tracker.find_run(tags)
            if known:
                tracker.resume(known)
            else:
                tracker.start_trial(self._place.trial_name(number), tags)
            params = {name: str(value) for name, value in self._settings[number].items()}
            tracker.log_params(params)  # of a known run, too: a kill may have come before it had them
            self._trackers[number] = tracker
        return self._trackers[number]

    def _in_mlflow(self, act: Callable[[], object]) -> None:
        """Does something in MLflow, without which the search goes on."""
        try:
            act()
        except (TrackingError, ConfigError) as error:
            reason = hide_secrets(first_line(error), self._place.tracking_uri)
            self._listener.message(f"MLflow lacks a trial's result: {reason}")


def _end_cell(location: SweepLocation, key: str) -> None:
    """Ends the MLflow run of a training that was ended early."""
    tracker = Tracker(location.tracking_uri, location.experiment, None)
    run_id = tracker.find_run({"cell": key, "sweep": location.sweep})
    if run_id is not None and not tracker.is_finished(run_id):
        tracker.run_id = run_id
        tracker.end("KILLED")


def _metric_name(objective: str) -> str:
    """The objective's name with the signs that MLflow takes."""
    return re.sub(r"[^\w./ -]", "_", objective)
