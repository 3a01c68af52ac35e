"""One run as a whole: folder, tracker, cluster and loop put together, started or resumed."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from typing import NamedTuple

from actors.evaluation.evaluator import evaluate_in_parallel
from actors.policy.network import WeightsSnapshot
from actors.service.fault_policy import CallFailed, ComponentFailed, FaultTracker, RunFailed, first_line
from actors.service.messages import EpisodeStats
from actors.storage.uri import Location
from learner.checkpoints.checkpoint import Checkpoint, check_config, check_state, newest_valid
from learner.checkpoints.manifest import CheckpointError, UnusableCheckpointError
from learner.config import RunConfig
from learner.file_names import CONFIG
from learner.loop import TrainingLoop
from learner.placement import Place
from learner.ray_backend.cluster import ray_cluster
from learner.ray_backend.metrics import RayMetrics
from learner.run_folder import RunFolder
from learner.tracking.delivery import Delivery, retry
from learner.tracking.fault_log import FaultLog
from learner.tracking.journal import Journal, PushedMark, Row
from learner.tracking.mlflow_run import MLFLOW_ERRORS, Tracker
from learner.tracking.observer import Display, MirroringObserver
from learner.tracking.redaction import hide_secrets
from learner.training.cluster import Cluster, process_cluster
from learner.training.evaluation_summary import Evaluation, as_metrics, summarise
from learner.training.recovery import RunLost
from learner.training.stop_signals import stop_on_signals

LAST_FLUSH_S = 5.0
"""How long a stopped run waits for MLflow; the next sitting delivers what it did not take."""

MISFITS = (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError)
"""What taking up a state of the wrong shape raises; a checksum cannot tell that it was written to do harm."""


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


def open_cluster(config: RunConfig, incarnation: int, place: Place) -> Cluster:
    """The run's parts under its engine."""
    if config.engine == "process":
        return process_cluster(config, incarnation)
    return ray_cluster(config, incarnation, place)


def resume_point(folder: RunFolder, config: RunConfig) -> tuple[Checkpoint, list[str]]:
    """The newest usable checkpoint of a run, and why newer ones were skipped.

    Raises:
      UnusableCheckpointError: there is none, or all are damaged or too old.
      CheckpointError: it cannot be reached, is of a newer version, or belongs to another config.
    """
    checkpoint, skipped = newest_valid(folder.checkpoint_location())
    check_state(checkpoint)
    check_config(checkpoint, config, folder.path / CONFIG)
    return checkpoint, skipped


def last_checkpoint(folder: RunFolder, config: RunConfig) -> Checkpoint | None:
    """The newest checkpoint of an earlier attempt; None where there is none of use, and the run begins anew.

    Raises:
      CheckpointError: it cannot be reached, is of a newer version, or belongs to another config.
    """
    try:
        return resume_point(folder, config)[0]
    except UnusableCheckpointError:
        return None


def execute(
    folder: RunFolder,
    config: RunConfig,
    tracker: Tracker,
    display: Display,
    checkpoint: Checkpoint | None,
    place: Place,
    finish: Callable[[RunResult, list[Row]], None],
) -> RunResult:
    """Trains from the start or from `checkpoint`, evaluates, and closes the MLflow run.

    Args:
      folder: the run's folder, held if others may reach for it (`RunFolder.hold`).
      config: the run.
      tracker: its MLflow run, started or resumed.
      display: shows progress.
      checkpoint: where to go on, None for a fresh start.
      place: where the parts go.
      finish: makes and logs the artifacts of a finished run from the result and all rows of metrics.

    Returns:
      How the run ended; the MLflow run is FINISHED, KILLED (stopped by a signal, resumable) or FAILED.

    Raises:
      RunFailed: a part of it fails again and again.
    """
    status, say = "FAILED", _without_secrets(display, tracker)
    try:
        result, rows = _train(folder, config, tracker, display, checkpoint, place)
        if result.evaluation is not None:
            patience_s = tracker.retry_timeout_s
            time_ms = _time_of_results(result, rows, tracker)
            metrics = as_metrics(result.evaluation)
            retry(lambda: tracker.log_results(metrics, time_ms), "the results", patience_s, say)
            retry(lambda: finish(result, rows), "the artifacts", patience_s, say)
        status = "FINISHED" if result.stopped_by is None else "KILLED"
        return result
    except KeyboardInterrupt:
        status = "KILLED"
        raise
    finally:
        _end(tracker, status, say)


def _without_secrets(display: Display, tracker: Tracker) -> Callable[[str], None]:
    """Shows what is said of MLflow, whose errors name its address, to a person."""
    return lambda text: display.message(hide_secrets(text, tracker.uri))


def _time_of_results(result: RunResult, rows: list[Row], tracker: Tracker) -> int:
    """The same for the same results, which are stored once however often they are sent, and another for later ones."""
    last = rows[-1] if rows else Row(0, tracker.started_ms, {})
    return last.time_ms + result.env_steps - last.env_steps


def _end(tracker: Tracker, status: str, say: Callable[[str], None]) -> None:
    """Closes the MLflow run; one that cannot be closed is so by the next sitting."""
    patience_s = tracker.retry_timeout_s if status == "FINISHED" else 0.0
    try:
        retry(lambda: tracker.end(status), f"that the run is {status}", patience_s, say)
    except MLFLOW_ERRORS as error:
        say(f"MLflow does not know that the run is {status}: {first_line(error)}")


def _train(
    folder: RunFolder,
    config: RunConfig,
    tracker: Tracker,
    display: Display,
    checkpoint: Checkpoint | None,
    place: Place,
) -> tuple[RunResult, list[Row]]:
    """Trains to the end, going back to the last checkpoint whenever a part is gone that only it can bring back."""
    recovery, faults, say = FaultTracker(), FaultLog(folder.faults), _without_secrets(display, tracker)
    incarnation = checkpoint.state["incarnation"] + 1 if checkpoint else 0
    resumed = checkpoint is not None
    monitor: Callable[[Row], None] | None = None
    while True:
        offset = checkpoint.state["journal_offset"] if checkpoint else 0
        with closing(Journal(folder.journal, offset)) as journal:
            cluster = open_cluster(config, incarnation, place)
            monitor = monitor or _monitor(folder, config)
            delivery = Delivery(tracker, journal, PushedMark(folder.pushed, offset), say)
            delivery.up_to(offset)
            with closing(delivery):
                observer = MirroringObserver(delivery, faults, display, monitor, resumed)
                try:
                    result = _attempt(folder, config, display, checkpoint, journal, cluster, observer, recovery)
                except RunLost as lost:
                    incarnation = lost.incarnation + 1
                else:
                    cluster.close()  # not after an error: references in its traceback must not outlive Ray
                    rows = journal.rows()
                    if result.evaluation is not None:
                        delivery.up_to(journal.length)  # even if the end has no checkpoint
                    _deliver_rest(delivery, tracker, result, say)
                    return result, rows
        resumed = False
        checkpoint = last_checkpoint(folder, config)
        display.message(f"going on from {checkpoint.folder if checkpoint else 'the start'}")


def _deliver_rest(delivery: Delivery, tracker: Tracker, result: RunResult, say: Callable[[str], None]) -> None:
    left = delivery.flush(LAST_FLUSH_S if result.stopped_by is not None else max(LAST_FLUSH_S, tracker.retry_timeout_s))
    if left is not None:
        say(f"MLflow lacks the newest metrics, which `shoal resume` sends again: {left}")


def _restore(loop: TrainingLoop, checkpoint: Checkpoint) -> None:
    try:
        loop.restore(checkpoint)
    except MISFITS as error:
        cause = getattr(error, "cause", error)  # what a Ray actor raised stands behind Ray's own error
        raise CheckpointError(f"checkpoint {checkpoint.folder} does not fit this run: {cause}") from error


def _monitor(folder: RunFolder, config: RunConfig) -> Callable[[Row], None]:
    """Shows rows to Prometheus where this process has joined a Ray."""
    return RayMetrics(folder.path.name).row if config.engine == "ray" else lambda row: None


def _attempt(
    folder: RunFolder,
    config: RunConfig,
    display: Display,
    checkpoint: Checkpoint | None,
    journal: Journal,
    cluster: Cluster,
    observer: MirroringObserver,
    recovery: FaultTracker,
) -> RunResult:
    """Trains with one set of parts.

    Raises:
      RunLost: a part is gone that only a checkpoint can bring back.
    """
    with stop_on_signals() as stop:
        keep_best = folder.storage().keep_best
        loop = TrainingLoop(config, cluster, journal, folder.checkpoint_location(), observer, stop, recovery, keep_best)
        try:
            if checkpoint is not None:
                _restore(loop, checkpoint)
            observer.ready()
            finished = loop.run()
            if not finished:
                return RunResult(loop.env_steps, loop.updates, loop.saved, stop.signal, None, None, None)
            display.message(f"training done; evaluating {config.final_eval_episodes} greedy episodes")
            weights = loop.newest_weights()
            episodes = final_evaluation(config, cluster, weights)
        except ComponentFailed as failure:  # outside of the rounds of training
            raise loop.lost(failure) from failure
        return RunResult(loop.env_steps, loop.updates, loop.saved, None, summarise(episodes), episodes, weights)


def final_evaluation(config: RunConfig, cluster: Cluster, weights: WeightsSnapshot) -> EpisodeStats:
    """Plays `weights` over `final_eval_episodes`, in parallel tasks that need none of the run's parts.

    Raises:
      RunFailed: a task fails again and again.
    """
    first = config.final_eval_first_seed
    seeds = list(range(first, first + config.final_eval_episodes))
    shared = cluster.calls.put(weights)
    try:
        return evaluate_in_parallel(cluster.calls, config.env, shared, seeds, cluster.eval_tasks)
    except CallFailed as failure:
        raise RunFailed(f"the evaluation at the end {failure.fault} again and again: {failure.reason}") from failure
