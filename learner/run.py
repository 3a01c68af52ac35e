"""One session of a run: restores a checkpoint or starts afresh, trains, makes the end, and ends the MLflow run.

A session is one process's work on a run; `shoal resume` begins the next one. A session makes one attempt or several:
each trains with one set of components. When a component is lost that only a checkpoint can bring back, the next attempt
starts from the newest checkpoint. Once all env steps are done, a session only makes what is missing of the end
(`learner.run_end`).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from functools import cached_property, partial
from typing import NamedTuple, TypeVar

import numpy as np

from actors.evaluation.evaluator import evaluate_in_parallel, worthwhile_calls
from actors.policy.policy import WeightsSnapshot
from actors.rollout.env_guard import env_guard
from actors.rollout.env_spec import EnvSpec
from actors.rollout.vector_env import env_shape
from actors.rollout.worker import select_stats
from actors.service.fault_policy import STEADY_CALLS, CallFailed, ComponentFailed, FaultTracker, RunFailed, first_line
from actors.service.messages import EpisodeStats
from actors.service.rpc import Calls, LocalCalls
from actors.storage.full_disk import DISK_TIMEOUT_S, is_disk_full, is_full
from actors.storage.uri import Location, join_location
from learner.checkpoints.checkpoint import Checkpoint, check_config, check_state, newest_valid
from learner.checkpoints.manifest import CheckpointError, UnusableCheckpointError
from learner.cluster_options import ClusterOptions
from learner.config import RunConfig
from learner.engine import open_calls, open_cluster
from learner.file_names import CONFIG
from learner.loop import TrainingLoop
from learner.own_processes import STOPPING
from learner.run_end import EndState, RunEnd, discard_end, final_seeds
from learner.run_folder import RunFolder
from learner.tracking.delivery import Delivery, retry
from learner.tracking.fault_log import FaultLog
from learner.tracking.journal import Journal, PushedMark, Row
from learner.tracking.observer import Display, MirroringObserver
from learner.tracking.redaction import hide_secrets
from learner.tracking.tracked_run import TrackedRun, TrackingError
from learner.training.cluster import Cluster
from learner.training.evaluation_summary import Evaluation, as_metrics, score, summarise
from learner.training.recovery import RunLost
from learner.training.stop_signals import StopRequest, stop_on_signals

T = TypeVar("T")

LAST_FLUSH_S = 5.0
"""How long a stopped run waits for MLflow; the next session delivers the rest."""

MISMATCH_ERRORS = (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError)
"""What restoring a state of the wrong shape raises. Checksums do not protect against a state written to do harm."""


class RunResult(NamedTuple):
    """How a session ended.

    `checkpoint` is the location of the run's last checkpoint, None if it could not be written. `stopped_by` is the
    number of the signal that stopped the run before its end, else None. `evaluation` summarises the final greedy
    `episodes`, played with `weights`; all three are None if the run was stopped. `by_setup` summarises them by setup
    where there are several. `is_known` tells whether MLflow knows how the session ended.
    """

    env_steps: int
    updates: int
    checkpoint: Location | None
    stopped_by: int | None
    evaluation: Evaluation | None
    episodes: EpisodeStats | None
    weights: WeightsSnapshot | None
    by_setup: dict[str, Evaluation]
    is_known: bool = True


class Step(NamedTuple):
    """A step of a run's end beside those of every run: its name, unique in the run, and a call that may be repeated."""

    name: str
    make: Callable[[], None]


MoreSteps = Callable[[RunResult, list[Row]], list[Step]]
"""The further steps of a finished run, from its result and all rows of metrics."""


class RunSession:
    """This process's work on a run.

    Args:
      folder: the run's folder; the caller locks it if another process may train the run (`RunFolder.lock`).
      config: the run's config.
      tracker: its MLflow run, started or resumed.
      display: shows progress to the user.
      options: the Ray cluster that holds the run's components, and its deadlines.
      opened: the components of the first attempt, where they have been started already.
    """

    def __init__(
        self,
        folder: RunFolder,
        config: RunConfig,
        tracker: TrackedRun,
        display: Display,
        options: ClusterOptions,
        opened: Cluster | None = None,
    ) -> None:
        self._folder = folder
        self._config = config
        self._tracker = tracker
        self._display = display
        self._options = options
        self._opened = opened
        self._fault_log = FaultLog(folder.faults, display.message)
        self._fault_tracker = FaultTracker(1 if config.env.is_swarm else STEADY_CALLS)

    def execute(self, checkpoint: Checkpoint | None, more_steps: MoreSteps) -> RunResult:
        """Trains to the end unless an earlier session did, makes what is missing of the end, and ends the MLflow run.

        Args:
          checkpoint: where to resume the training, None for a fresh start.
          more_steps: the further steps of the end, such as making and logging the artifacts.

        Returns:
          How the session ended. The MLflow run is FINISHED, or KILLED if a signal stopped it; then it can be resumed.

        Raises:
          RunFailed: a component or a step of the end fails again and again, or the training diverges; the MLflow run is
            FAILED.
          ConfigError: a user's own code does what it must not; the MLflow run is FAILED.
          Interrupted: a signal arrived while the session started or made the end; the MLflow run is KILLED.
        """
        status, is_known = "FAILED", False
        with closing(self._fault_log), stop_on_signals(*STOPPING) as stop:
            try:
                with stop.at_once(), self._folder.traceback_kept(), self._guard():
                    result = self._train_and_end(checkpoint, more_steps, stop)
                status = "FINISHED" if result.stopped_by is None else "KILLED"
            except (KeyboardInterrupt, SystemExit):  # the latter from Ray's handler, or a search that ends a trial
                status = "KILLED"
                raise
            finally:
                is_known = self._end(status)
            return result._replace(is_known=is_known)

    def _guard(self) -> AbstractContextManager[None]:
        """Keeps a foreign environment from hanging this process or leaving it; those of Ray's actors have deadlines."""
        return nullcontext() if self._config.env.is_swarm else env_guard(self._options.deadline_s)

    def _train_and_end(self, checkpoint: Checkpoint | None, more_steps: MoreSteps, stop: StopRequest) -> RunResult:
        """What is missing of the training, unless a signal stops it, and of the end."""
        outcome = RunEnd.open(self._folder.end, self._config) or self._train(checkpoint, stop)
        return outcome if isinstance(outcome, RunResult) else self._make_end(outcome, more_steps, stop)

    def _train(self, checkpoint: Checkpoint | None, stop: StopRequest) -> RunResult | RunEnd:
        """Makes attempts until one succeeds; returns how a signal stopped it, or else the end that it began."""
        discard_end(self._folder.end)
        incarnation = checkpoint.state["incarnation"] + 1 if checkpoint else 0
        resumed = checkpoint is not None
        while True:
            try:
                return self._attempt(checkpoint, incarnation, resumed, stop)
            except RunLost as lost:
                incarnation = lost.incarnation + 1
            resumed = False
            checkpoint = last_checkpoint(self._folder, self._config)
            self._display.message(f"going on from {checkpoint.folder if checkpoint else 'the start'}")

    def _attempt(
        self, checkpoint: Checkpoint | None, incarnation: int, resumed: bool, stop: StopRequest
    ) -> RunResult | RunEnd:
        """Trains and evaluates with one set of components, whose first incarnation is `incarnation`.

        Raises:
          RunLost: a component is lost that only a checkpoint can bring back.
        """
        offset = checkpoint.state["journal_offset"] if checkpoint else 0
        with closing(self._journal(offset)) as journal:
            cluster, self._opened = self._opened or open_cluster(self._config, incarnation, self._options), None
            stop.listen(STOPPING)  # Ray has set a handler of its own
            with closing(self._delivery(journal, offset)) as delivery:
                delivery.deliver_up_to(offset)
                observer = MirroringObserver(delivery, self._fault_log, self._display, self._monitor, resumed)
                outcome = self._run_loop(checkpoint, journal, cluster, observer, stop)
                cluster.close()  # not after an error: references in its traceback must not outlive Ray
                if isinstance(outcome, RunResult):
                    self._say_undelivered(delivery.flush(LAST_FLUSH_S))
                return outcome

    def _journal(self, offset: int) -> Journal:
        return Journal(self._folder.journal, offset, self._display.message)

    def _delivery(self, journal: Journal, offset: int) -> Delivery:
        return Delivery(self._tracker, journal, PushedMark(self._folder.pushed, offset), self._say)

    def _run_loop(
        self,
        checkpoint: Checkpoint | None,
        journal: Journal,
        cluster: Cluster,
        observer: MirroringObserver,
        stop: StopRequest,
    ) -> RunResult | RunEnd:
        """Restores, trains, and evaluates the final policy; returns how a signal stopped it, or the end that it began.

        Raises:
          RunLost: see `_attempt`.
        """
        checkpoints, keep_best = self._folder.checkpoint_location(), self._folder.storage().keep_best
        loop = TrainingLoop(self._config, cluster, journal, checkpoints, observer, stop, self._fault_tracker, keep_best)
        try:
            if checkpoint is not None:
                _restore(loop, checkpoint)
            observer.ready()
            with stop.at_once(False):  # the loop asks for the request, and saves before it stops
                is_done = loop.run()
            if not is_done:
                return RunResult(loop.env_steps, loop.updates, loop.saved, stop.signal, None, None, None, {})
            end = self._begin_end(loop, journal)
            stop.check()
            with self._calls_to_play(cluster, stop) as (calls, max_calls):
                self._evaluate(end, calls, max_calls)
            return end
        except ComponentFailed as failure:  # before or after the rounds of training
            raise loop.lost(failure) from failure

    def _begin_end(self, loop: TrainingLoop, journal: Journal) -> RunEnd:
        """Makes durable that all env steps are done, and what the end works from."""
        saved = None if loop.saved is None else str(loop.saved).rsplit("/", 1)[1]
        state = EndState(loop.env_steps, loop.updates, self._patiently(journal.sync, "the metrics"), saved, [])
        weights = loop.newest_weights()
        begin = partial(RunEnd.begin, self._folder.end, self._config, state, weights)
        return self._patiently(begin, "the policy")

    def _evaluate(self, end: RunEnd, calls: Calls, max_calls: int) -> None:
        """Plays the final episodes that are missing by `calls`, which need no component of the run.

        Raises:
          RunFailed: a task fails again and again.
        """
        num_calls = worthwhile_calls(self._config.env, self._config.final_eval_episodes, max_calls)

        def play(spec: EnvSpec, weights: WeightsSnapshot) -> EpisodeStats:
            return evaluate_in_parallel(calls, spec, calls.put(weights), final_seeds(self._config), num_calls)

        episodes = f"{self._config.final_eval_episodes} greedy episodes"
        self._display.message(f"training done; evaluating {episodes}")
        self._tracker.begin_policy(end.weights, self._config, env_shape(self._config.env))
        try:
            self._patiently(partial(end.evaluate, play), "the final episodes")
        except CallFailed as failure:
            whose = "" if self._config.env.is_swarm else f" of env_id {self._config.env_id!r}"
            raise RunFailed(
                f"the evaluation{whose} at the end {failure.fault} again and again: {failure.reason}"
            ) from failure

    @contextmanager
    def _calls_to_play(self, cluster: Cluster | None, stop: StopRequest) -> Iterator[tuple[Calls, int]]:
        """Calls that play the final episodes, and how many to make at once: of this process, or else of parallel tasks.

        This process plays them itself where another one would hardly play before it is done. A user's own method or
        scene is played in a task, which has a deadline.

        Args:
          cluster: the run's components, if they still run.
          stop: listens again once Ray has been started.
        """
        config = self._config
        is_ours = config.env.is_swarm and not any(world.sources for world in config.env.worlds)
        if is_ours and worthwhile_calls(config.env, config.final_eval_episodes, 2) == 1:
            yield LocalCalls(), 1
        elif cluster is not None:
            yield cluster.calls, cluster.limits.eval_tasks
        else:
            with open_calls(config, self._options) as tasks:
                stop.listen(STOPPING)  # Ray has set a handler of its own
                yield tasks

    def _make_end(self, end: RunEnd, more_steps: MoreSteps, stop: StopRequest) -> RunResult:
        """Makes the steps of the end that are missing; returns the run's result.

        Raises:
          RunFailed: a step cannot be made now.
        """
        if end.episodes() is None:
            with self._calls_to_play(None, stop) as (calls, max_calls):
                self._evaluate(end, calls, max_calls)
        result, rows = self._result(end), self._deliver_all(end)
        steps = [Step("the results", partial(self._log_results, result, rows)), *more_steps(result, rows)]
        for name, make in steps:
            end.make(name, partial(self._patiently, make, name))
        return result

    def _result(self, end: RunEnd) -> RunResult:
        episodes = end.episodes()
        assert episodes is not None
        env_steps, updates, _, name, _ = end.state
        checkpoint = name and join_location(self._folder.checkpoint_location(), name)
        by_setup = evaluation_by_setup(self._config, episodes)
        return RunResult(env_steps, updates, checkpoint, None, summarise(episodes), episodes, end.weights, by_setup)

    def _deliver_all(self, end: RunEnd) -> list[Row]:
        """Waits until MLflow has all rows of metrics; returns them.

        Raises:
          RunFailed: it does not take them in time.
        """
        length = end.state.journal_bytes
        with closing(self._journal(length)) as journal, closing(self._delivery(journal, length)) as delivery:
            delivery.deliver_up_to(length)
            reason = delivery.flush(max(LAST_FLUSH_S, self._tracker.retry_timeout_s))
            if reason is not None and is_full(reason):
                reason = delivery.flush(DISK_TIMEOUT_S)
            if reason is not None:
                raise self._lacking("the newest metrics", reason)
            return journal.rows()

    def _lacking(self, what: str, reason: str) -> RunFailed:
        told = hide_secrets(reason, self._tracker.uri)
        return RunFailed(
            f"the run is trained, but its end lacks {what} ({told}); `shoal resume {self._folder.path}` makes it"
        )

    def _patiently(self, make: Callable[[], T], what: str) -> T:
        """Makes a step once MLflow and the disk take it.

        Raises:
          RunFailed: they did not in time.
        """
        try:
            return retry(make, what, self._tracker.retry_timeout_s, self._say)
        except Exception as error:
            if not (isinstance(error, TrackingError) or is_disk_full(error)):
                raise
            raise self._lacking(what, first_line(error)) from error

    @cached_property
    def _monitor(self) -> Callable[[Row], None]:
        """Exports rows to Prometheus; made once this process has joined Ray."""
        if self._config.engine == "process":
            return lambda row: None
        from learner.ray_backend.metrics import RayMetrics

        return RayMetrics(self._folder.path.name).row

    def _say(self, text: str) -> None:
        """Shows a line about MLflow, whose errors contain its address, without the address's password."""
        self._display.message(hide_secrets(text, self._tracker.uri))

    def _say_undelivered(self, reason: str | None) -> None:
        if reason is not None:
            self._say(f"MLflow lacks the newest metrics, which `shoal resume` sends again: {reason}")

    def _log_results(self, result: RunResult, rows: list[Row]) -> None:
        assert result.evaluation is not None
        metrics = as_metrics(result.evaluation)
        if result.by_setup:
            metrics["worst_setup"] = min(map(score, result.by_setup.values()))
        self._tracker.log_results(metrics, self._time_of_results(result, rows))

    def _time_of_results(self, result: RunResult, rows: list[Row]) -> int:
        """A time in ms that is the same however often a result is logged, and differs once the run is trained on."""
        last = rows[-1] if rows else Row(0, self._tracker.started_ms, {})
        return last.time_ms + result.env_steps - last.env_steps

    def _end(self, status: str) -> bool:
        """Ends the MLflow run; returns whether MLflow took it. Where it did not, the next session ends the run."""
        timeout_s = self._tracker.retry_timeout_s if status == "FINISHED" else 0.0
        try:
            retry(lambda: self._tracker.end(status), f"that the run is {status}", timeout_s, self._say)
            return True
        except TrackingError as error:
            self._say(f"MLflow does not know that the run is {status}: {first_line(error)}")
            return False


def evaluation_by_setup(config: RunConfig, episodes: EpisodeStats) -> dict[str, Evaluation]:
    """Summaries of the final evaluation by setup, such as `10r×2g`; empty where there is only one."""
    setups = config.env.worlds
    if len(setups) == 1:
        return {}
    ends = np.cumsum([config.final_eval_episodes * learners for learners in config.env.learners()]).tolist()
    chunks = [select_stats(episodes, slice(*part)) for part in itertools.pairwise([0, *ends])]
    return {world.setup: summarise(chunk) for world, chunk in zip(setups, chunks, strict=True)}


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
