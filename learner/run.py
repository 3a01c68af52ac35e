"""One session of a run: restores a checkpoint or starts afresh, trains, evaluates, logs, and ends the MLflow run.

A session is one process's work on a run; `shoal resume` begins the next one. A session makes one attempt or several:
each trains with one set of components. When a component is lost that only a checkpoint can bring back, the next attempt
starts from the newest checkpoint.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, closing, nullcontext
from functools import cached_property
from typing import NamedTuple

from actors.evaluation.evaluator import evaluate_in_parallel
from actors.policy.policy import WeightsSnapshot
from actors.rollout.env_guard import env_guard
from actors.rollout.worker import join_stats, select_stats
from actors.service.fault_policy import STEADY_CALLS, CallFailed, ComponentFailed, FaultTracker, RunFailed, first_line
from actors.service.messages import EpisodeStats
from actors.storage.uri import Location
from learner.checkpoints.checkpoint import Checkpoint, check_config, check_state, newest_valid
from learner.checkpoints.manifest import CheckpointError, UnusableCheckpointError
from learner.cluster_options import ClusterOptions
from learner.config import RunConfig
from learner.file_names import CONFIG
from learner.loop import TrainingLoop
from learner.ray_backend.cluster import RayCluster
from learner.ray_backend.metrics import RayMetrics
from learner.run_folder import RunFolder
from learner.tracking.delivery import Delivery, retry
from learner.tracking.fault_log import FaultLog
from learner.tracking.journal import Journal, PushedMark, Row
from learner.tracking.mlflow_run import MLFLOW_ERRORS, Tracker
from learner.tracking.observer import Display, MirroringObserver
from learner.tracking.redaction import hide_secrets
from learner.training.cluster import Cluster, ProcessCluster
from learner.training.evaluation_summary import Evaluation, as_metrics, score, summarise
from learner.training.recovery import RunLost
from learner.training.stop_signals import stop_on_signals

LAST_FLUSH_S = 5.0
"""How long a stopped run waits for MLflow; the next session delivers the rest."""

MISMATCH_ERRORS = (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError)
"""What restoring a state of the wrong shape raises. Checksums do not protect against a state written to do harm."""


class RunResult(NamedTuple):
    """How a session ended.

    `checkpoint` is the location of the session's last checkpoint, None if it could not be written. `stopped_by` is the
    number of the signal that stopped the run before its end, else None. `evaluation` summarises the final greedy
    `episodes`, played with `weights`; all three are None if the run was stopped. `by_setup` summarises them by setup
    where there are several.
    """

    env_steps: int
    updates: int
    checkpoint: Location | None
    stopped_by: int | None
    evaluation: Evaluation | None
    episodes: EpisodeStats | None
    weights: WeightsSnapshot | None
    by_setup: dict[str, Evaluation]


class RunSession:
    """This process's work on a run.

    Args:
      folder: the run's folder; the caller locks it if another process may train the run (`RunFolder.lock`).
      config: the run's config.
      tracker: its MLflow run, started or resumed.
      display: shows progress to the user.
      options: the Ray cluster that holds the run's components, and its deadlines.
    """

    def __init__(
        self, folder: RunFolder, config: RunConfig, tracker: Tracker, display: Display, options: ClusterOptions
    ) -> None:
        self._folder = folder
        self._config = config
        self._tracker = tracker
        self._display = display
        self._options = options
        self._fault_log = FaultLog(folder.faults)
        self._fault_tracker = FaultTracker(1 if config.env.is_swarm else STEADY_CALLS)

    def execute(self, checkpoint: Checkpoint | None, finish: Callable[[RunResult, list[Row]], None]) -> RunResult:
        """Trains to the end, evaluates, logs the result and ends the MLflow run.

        Args:
          checkpoint: where to resume, None for a fresh start.
          finish: makes and logs the artifacts of a finished run from its result and all rows of metrics; called again
            where MLflow fails.

        Returns:
          How the session ended. The MLflow run is FINISHED, or KILLED if a signal stopped it; then it can be resumed.

        Raises:
          RunFailed: a component fails again and again, or the training diverges; the MLflow run is FAILED.
          ConfigError: a user's own code does what it must not; the MLflow run is FAILED.
        """
        status = "FAILED"
        try:
            with self._folder.traceback_kept(), self._guard():
                result, rows = self._train_and_evaluate(checkpoint)
                if result.evaluation is not None:
                    self._log(result, result.evaluation, rows, finish)
            status = "FINISHED" if result.stopped_by is None else "KILLED"
            return result
        except (KeyboardInterrupt, SystemExit):  # the latter where a search ends a trial early
            status = "KILLED"
            raise
        finally:
            self._end(status)

    def _guard(self) -> AbstractContextManager[None]:
        """Keeps a foreign environment from hanging this process or leaving it; those of Ray's actors have deadlines."""
        return nullcontext() if self._config.env.is_swarm else env_guard(self._options.deadline_s)

    def _train_and_evaluate(self, checkpoint: Checkpoint | None) -> tuple[RunResult, list[Row]]:
        """Makes attempts until one succeeds; returns its result and all rows of metrics."""
        incarnation = checkpoint.state["incarnation"] + 1 if checkpoint else 0
        resumed = checkpoint is not None
        while True:
            try:
                return self._attempt(checkpoint, incarnation, resumed)
            except RunLost as lost:
                incarnation = lost.incarnation + 1
            resumed = False
            checkpoint = last_checkpoint(self._folder, self._config)
            self._display.message(f"going on from {checkpoint.folder if checkpoint else 'the start'}")

    def _attempt(self, checkpoint: Checkpoint | None, incarnation: int, resumed: bool) -> tuple[RunResult, list[Row]]:
        """Trains and evaluates with one set of components, whose first incarnation is `incarnation`.

        Raises:
          RunLost: a component is lost that only a checkpoint can bring back.
        """
        offset = checkpoint.state["journal_offset"] if checkpoint else 0
        with closing(Journal(self._folder.journal, offset)) as journal:
            cluster = open_cluster(self._config, incarnation, self._options)
            with closing(
                Delivery(self._tracker, journal, PushedMark(self._folder.pushed, offset), self._say)
            ) as delivery:
                delivery.deliver_up_to(offset)
                observer = MirroringObserver(delivery, self._fault_log, self._display, self._monitor, resumed)
                result = self._run_loop(checkpoint, journal, cluster, observer)
                cluster.close()  # not after an error: references in its traceback must not outlive Ray
                if result.evaluation is not None:
                    delivery.deliver_up_to(journal.length)  # even if the last checkpoint could not be written
                self._flush(delivery, result)
                return result, journal.rows()

    def _run_loop(
        self, checkpoint: Checkpoint | None, journal: Journal, cluster: Cluster, observer: MirroringObserver
    ) -> RunResult:
        """Restores, trains, and evaluates the final policy.

        Raises:
          RunLost: see `_attempt`.
        """
        checkpoints, keep_best = self._folder.checkpoint_location(), self._folder.storage().keep_best
        with stop_on_signals() as stop:
            loop = TrainingLoop(
                self._config, cluster, journal, checkpoints, observer, stop, self._fault_tracker, keep_best
            )
            try:
                if checkpoint is not None:
                    _restore(loop, checkpoint)
                observer.ready()
                if not loop.run():
                    return RunResult(loop.env_steps, loop.updates, loop.saved, stop.signal, None, None, None, {})
                self._display.message(f"training done; evaluating {self._config.final_eval_episodes} greedy episodes")
                weights = loop.newest_weights()
                episodes = final_evaluation(self._config, cluster, weights)
            except ComponentFailed as failure:  # before or after the rounds of training
                raise loop.lost(failure) from failure
            by_setup = evaluation_by_setup(self._config, episodes)
            evaluation = summarise(episodes)
            return RunResult(loop.env_steps, loop.updates, loop.saved, None, evaluation, episodes, weights, by_setup)

    @cached_property
    def _monitor(self) -> Callable[[Row], None]:
        """Exports rows to Prometheus; made once this process has joined Ray."""
        return RayMetrics(self._folder.path.name).row if self._config.engine == "ray" else lambda row: None

    def _say(self, text: str) -> None:
        """Shows a line about MLflow, whose errors contain its address, without the address's password."""
        self._display.message(hide_secrets(text, self._tracker.uri))

    def _flush(self, delivery: Delivery, result: RunResult) -> None:
        is_stopped = result.stopped_by is not None
        reason = delivery.flush(LAST_FLUSH_S if is_stopped else max(LAST_FLUSH_S, self._tracker.retry_timeout_s))
        if reason is not None:
            self._say(f"MLflow lacks the newest metrics, which `shoal resume` sends again: {reason}")

    def _log(
        self,
        result: RunResult,
        evaluation: Evaluation,
        rows: list[Row],
        finish: Callable[[RunResult, list[Row]], None],
    ) -> None:
        """Logs the results and the artifacts of a finished run, and retries while MLflow fails."""
        tracker, timeout_s = self._tracker, self._tracker.retry_timeout_s
        metrics, time_ms = as_metrics(evaluation), self._time_of_results(result, rows)
        if result.by_setup:
            metrics["worst_setup"] = min(map(score, result.by_setup.values()))
        retry(lambda: tracker.log_results(metrics, time_ms), "the results", timeout_s, self._say)
        retry(lambda: finish(result, rows), "the artifacts", timeout_s, self._say)

    def _time_of_results(self, result: RunResult, rows: list[Row]) -> int:
        """A time in ms that is the same however often a result is logged, and differs once the run is trained on."""
        last = rows[-1] if rows else Row(0, self._tracker.started_ms, {})
        return last.time_ms + result.env_steps - last.env_steps

    def _end(self, status: str) -> None:
        """Ends the MLflow run; where MLflow fails, the next session ends it."""
        timeout_s = self._tracker.retry_timeout_s if status == "FINISHED" else 0.0
        try:
            retry(lambda: self._tracker.end(status), f"that the run is {status}", timeout_s, self._say)
        except MLFLOW_ERRORS as error:
            self._say(f"MLflow does not know that the run is {status}: {first_line(error)}")


def evaluation_by_setup(config: RunConfig, episodes: EpisodeStats) -> dict[str, Evaluation]:
    """Summaries of the final evaluation by setup, such as `10r×2g`; empty where there is only one."""
    setups, size = config.env.worlds, config.final_eval_episodes
    if len(setups) == 1:
        return {}
    chunks = [select_stats(episodes, slice(i * size, (i + 1) * size)) for i in range(len(setups))]
    return {world.setup: summarise(chunk) for world, chunk in zip(setups, chunks, strict=True)}


def open_cluster(config: RunConfig, incarnation: int, options: ClusterOptions) -> Cluster:
    """Starts the run's components under its engine."""
    if config.engine == "process":
        return ProcessCluster(config, incarnation)
    return RayCluster(config, incarnation, options)


def resume_point(folder: RunFolder, config: RunConfig) -> tuple[Checkpoint, list[str]]:
    """The newest usable checkpoint of a run, and why newer ones were skipped.

    Raises:
      UnusableCheckpointError: there is none, or all are damaged or in an older format.
      CheckpointError: it cannot be reached, is in a newer format, or was made with another config.
    """
    checkpoint, skipped = newest_valid(folder.checkpoint_location())
    check_state(checkpoint)
    check_config(checkpoint, config, folder.path / CONFIG)
    return checkpoint, skipped


def last_checkpoint(folder: RunFolder, config: RunConfig) -> Checkpoint | None:
    """The newest usable checkpoint of a run; None if there is none, and the run must start afresh.

    Raises:
      CheckpointError: it cannot be reached, is in a newer format, or was made with another config.
    """
    try:
        return resume_point(folder, config)[0]
    except UnusableCheckpointError:
        return None


def _restore(loop: TrainingLoop, checkpoint: Checkpoint) -> None:
    try:
        loop.restore(checkpoint)
    except MISMATCH_ERRORS as error:
        cause = getattr(error, "cause", error)  # Ray wraps what an actor raises
        raise CheckpointError(f"checkpoint {checkpoint.folder} does not fit this run: {cause}") from error


def final_evaluation(config: RunConfig, cluster: Cluster, weights: WeightsSnapshot) -> EpisodeStats:
    """Plays `final_eval_episodes` greedy episodes with `weights`, in parallel tasks that need no component of the run.

    Returns:
      One entry per episode; of several setups, that many of each, one setup after the other.

    Raises:
      RunFailed: a task fails again and again.
    """
    first = config.final_eval_first_seed
    seeds = list(range(first, first + config.final_eval_episodes))
    shared = cluster.calls.put(weights)
    specs = [config.env.of_setup(world) for world in config.env.worlds]
    try:
        return join_stats(
            [evaluate_in_parallel(cluster.calls, spec, shared, seeds, cluster.limits.eval_tasks) for spec in specs]
        )
    except CallFailed as failure:
        whose = "" if config.env.is_swarm else f" of env_id {config.env_id!r}"
        raise RunFailed(
            f"the evaluation{whose} at the end {failure.fault} again and again: {failure.reason}"
        ) from failure
