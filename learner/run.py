"""One run as a whole: folder, tracker, cluster and loop put together, started or resumed."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from typing import NamedTuple, Protocol

from actors.locations import Location
from actors.network import WeightsSnapshot
from actors.transitions import EpisodeStats
from learner.addresses import hide_secrets
from learner.checkpoint import Checkpoint, newest_valid
from learner.cluster import Cluster, process_cluster
from learner.config import RunConfig
from learner.journal import Journal, PushedMark, Row
from learner.loop import TrainingLoop
from learner.manifest import CheckpointError
from learner.ray_edge import ray_cluster
from learner.results import Evaluation, final_metrics, summarise
from learner.run_folder import RunFolder
from learner.saved_state import check_config, check_state
from learner.stopping import stop_on_signals
from learner.tracker import Tracker

MISFITS = (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError)
"""What taking up a state of the wrong shape raises; a checksum cannot tell that it was written to do harm."""


class Display(Protocol):
    """What shows a run to a person."""

    def row(self, row: Row) -> None:
        """A row of metrics was written."""
        ...

    def message(self, text: str) -> None:
        """Something worth a line happened."""
        ...


class RunResult(NamedTuple):
    """How a run ended; `evaluation`, its `episodes` and `weights` are None if a signal stopped it before its end.

    `checkpoint` is the location of the checkpoint of its end, None if that could not be written.
    """

    env_steps: int
    updates: int
    checkpoint: Location | None
    stopped_by: int | None
    evaluation: Evaluation | None
    episodes: EpisodeStats | None
    weights: WeightsSnapshot | None


class MirroringObserver:
    """Passes rows on to the display, and to MLflow once a checkpoint covers them.

    Args:
      tracker: the MLflow run.
      journal: the run's journal.
      pushed: remembers how much of it MLflow has.
      display: shows rows to a person.
    """

    def __init__(self, tracker: Tracker, journal: Journal, pushed: PushedMark, display: Display) -> None:
        self._tracker = tracker
        self._journal = journal
        self._pushed = pushed
        self._display = display

    def row(self, row: Row) -> None:
        """Shows the row."""
        self._display.row(row)

    def checkpoint_failed(self, env_steps: int, reason: str) -> None:
        """Says so; the next checkpoint is tried as usual."""
        self._display.message(f"the checkpoint of {env_steps:,} env steps could not be written: {reason}")

    def checkpoint(self, folder: Location, journal_offset: int) -> None:
        """Pushes the rows that the checkpoint covers; what fails is pushed with the next checkpoint."""
        try:
            self._tracker.push(self._journal.rows(self._pushed.read(), journal_offset))
        except Exception as error:  # the client raises its own, requests' and SQLAlchemy's errors alike
            reason = hide_secrets(_first_line(error), self._tracker.uri)
            self._display.message(f"MLflow did not take the metrics, they will be sent again: {reason}")
            return
        self._pushed.write(journal_offset)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def open_cluster(config: RunConfig, incarnation: int, address: str | None) -> Cluster:
    """The run's parts under its engine."""
    if config.engine == "process":
        return process_cluster(config, incarnation)
    return ray_cluster(config, incarnation, address)


def resume_point(folder: RunFolder, config: RunConfig) -> tuple[Checkpoint, list[str]]:
    """The newest usable checkpoint of a run, and why newer ones were skipped.

    Raises:
      UselessCheckpointError: there is none, or all are damaged or too old.
      CheckpointError: it cannot be reached, is of a newer version, or belongs to another config.
    """
    checkpoint, skipped = newest_valid(folder.checkpoint_location())
    check_state(checkpoint)
    check_config(checkpoint, config, folder.path / "config.json")
    return checkpoint, skipped


def execute(
    folder: RunFolder,
    config: RunConfig,
    tracker: Tracker,
    display: Display,
    checkpoint: Checkpoint | None,
    address: str | None,
    finish: Callable[[RunResult, list[Row]], None],
) -> RunResult:
    """Trains from the start or from `checkpoint`, evaluates, and closes the MLflow run.

    Args:
      folder: the run's folder.
      config: the run.
      tracker: its MLflow run, started or resumed.
      display: shows progress.
      checkpoint: where to go on, None for a fresh start.
      address: Ray cluster, None for this machine.
      finish: makes and logs the artifacts of a finished run from the result and all rows of metrics.

    Returns:
      How the run ended; the MLflow run is FINISHED, KILLED (stopped by a signal, resumable) or FAILED.
    """
    state = checkpoint.state if checkpoint else {"incarnation": -1, "journal_offset": 0}
    status = "FAILED"
    try:
        with closing(Journal(folder.journal, state["journal_offset"])) as journal:
            cluster = open_cluster(config, state["incarnation"] + 1, address)
            result = _train(folder, config, tracker, display, checkpoint, journal, cluster)
            cluster.close()  # not after an error: references in its traceback must not outlive Ray, which ends at exit
            if result.evaluation is not None:
                rows = journal.rows()
                time_ms = rows[-1].time_ms if rows else int(time.time() * 1000)
                tracker.final(final_metrics(result.evaluation), time_ms)
                finish(result, rows)
        status = "FINISHED" if result.stopped_by is None else "KILLED"
        return result
    except KeyboardInterrupt:
        status = "KILLED"
        raise
    finally:
        tracker.end(status)


def _restore(loop: TrainingLoop, checkpoint: Checkpoint) -> None:
    try:
        loop.restore(checkpoint)
    except MISFITS as error:
        cause = getattr(error, "cause", error)  # what a Ray actor raised stands behind Ray's own error
        raise CheckpointError(f"checkpoint {checkpoint.folder} does not fit this run: {cause}") from error


def _train(
    folder: RunFolder,
    config: RunConfig,
    tracker: Tracker,
    display: Display,
    checkpoint: Checkpoint | None,
    journal: Journal,
    cluster: Cluster,
) -> RunResult:
    observer = MirroringObserver(tracker, journal, PushedMark(folder.pushed, journal.sync()), display)
    with stop_on_signals() as stop:
        storage = folder.storage()
        loop = TrainingLoop(config, cluster, journal, folder.checkpoint_location(), observer, stop, storage.keep_best)
        if checkpoint is not None:
            _restore(loop, checkpoint)
        finished = loop.run()
        if not finished:
            return RunResult(loop.env_steps, loop.updates, loop.saved, stop.signal, None, None, None)
        display.message(f"training done; evaluating {config.final_eval_episodes} greedy episodes")
        episodes, weights = loop.final_evaluation(), loop.newest_weights()
        return RunResult(loop.env_steps, loop.updates, loop.saved, None, summarise(episodes), episodes, weights)
