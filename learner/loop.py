"""The training loop: act, step, store, sample, update, sync; in one process or over Ray actors.

The loop holds references and small reports. The transitions themselves go from a rollout worker to a replay shard and
from there to the learner; the weights go from the learner to the shards, whose replies carry them to the workers.

Each method of a node that the loop calls (`RolloutNode.collect`, `LearnerNode.update`) is the next hop to read.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol, TypeVar, TypeVarTuple

from actors.evaluation.evaluator import evaluate
from actors.policy.policy import WeightsSnapshot
from actors.rollout.exploration import epsilon
from actors.rollout.node import RolloutNode
from actors.service.fault_policy import CallFailed, Component, ComponentFailed, ComponentKind, Diverged, FaultTracker
from actors.service.messages import BlockReport, EpisodeStats
from actors.service.rpc import Placed, by_reference
from actors.storage.full_disk import DISK_TIMEOUT_S
from actors.storage.uri import Location
from learner.checkpoints.checkpoint import Checkpoint
from learner.checkpoints.writer import CheckpointWriter
from learner.config import RunConfig
from learner.tracking.journal import Journal, Row
from learner.training.checkpoint_manager import CheckpointManager, CheckpointObserver
from learner.training.cluster import Cluster
from learner.training.counters import Progress
from learner.training.evaluation_summary import as_metrics, summarise
from learner.training.in_flight import InFlight, PendingCall
from learner.training.ledger import Ledger
from learner.training.pacing import make_pacer
from learner.training.recovery import FaultObserver, RunLost, Supervisor
from learner.update.learner_node import LearnerNode

N = TypeVar("N")
T = TypeVar("T")
Ts = TypeVarTuple("Ts")

EVAL_SEED = 1_000_000_000
"""First seed of the evaluations during training; training worlds draw theirs from other streams."""
DISK_PAUSE_S = 5.0
"""Time between two attempts to write the last checkpoint to a full disk."""
LEARNER = Component(ComponentKind.LEARNER)
EVALUATOR = Component(ComponentKind.EVALUATOR)


class Observer(FaultObserver, CheckpointObserver, Protocol):
    """What the loop tells its surroundings."""

    def row(self, row: Row) -> None:
        """A row of metrics was written."""
        ...


class TrainingLoop:
    """Trains one run from its start or from a checkpoint to its end.

    Args:
      config: the run.
      cluster: its nodes.
      journal: where metrics go.
      checkpoints: folder or URL of the run's checkpoints.
      observer: hears of rows, checkpoints and failures.
      stop: asked once a round; True ends the run early, with a checkpoint.
      faults: decides about failed components; remembers the failures of earlier attempts.
      keep_best: how many of the best checkpoints are kept beside the newest.
    """

    def __init__(
        self,
        config: RunConfig,
        cluster: Cluster,
        journal: Journal,
        checkpoints: Location,
        observer: Observer,
        stop: Callable[[], bool],
        faults: FaultTracker | None = None,
        keep_best: int = 0,
    ) -> None:
        limits = cluster.limits
        self._config = config
        self._cluster = cluster
        self._calls = cluster.calls
        self._limits = limits
        self._journal = journal
        self._observer = observer
        self._stop = stop
        self._pacer = make_pacer(config, limits.blocks_in_flight)
        self._ledger = Ledger(config.workers, cluster.capacities)
        self._progress = Progress(config, self._pacer, self._ledger)
        self._in_flight = InFlight(config.workers, limits.deadline_s, limits.start_deadline_s)
        self._supervisor = Supervisor(
            cluster, faults or FaultTracker(), self._in_flight, self._pacer, self._ledger, observer
        )
        writer = CheckpointWriter(checkpoints, cluster.calls, limits.queue_deadline_s)
        self._checkpoints = CheckpointManager(
            config, keep_best, writer, self._supervisor, self._progress, journal, observer
        )
        self._restored = False

    @property
    def env_steps(self) -> int:
        """Env steps so far."""
        return self._progress.env_steps

    @property
    def updates(self) -> int:
        """Updates so far."""
        return self._progress.updates

    @property
    def saved(self) -> Location | None:
        """The checkpoint of the present env steps and updates; None if there is none."""
        return self._checkpoints.saved

    def run(self) -> bool:
        """Trains to `total_env_steps` or until stopped, and checkpoints the end.

        Returns:
          Whether the run is finished (else it was stopped).

        Raises:
          RuntimeError: nothing is in flight and nothing may start.
          RunLost: a component failed that only a checkpoint can bring back.
          RunFailed: a component failed again and again.
          Diverged: numbers of the learner are no longer finite; the checkpoints hold finite ones only.
          ComponentFailed: a component failed before the first round.
        """
        try:
            return self._run()
        except Diverged as diverged:
            self._checkpoints.wait()  # what is being written is from before
            self._abandon()
            kept = f"the last checkpoint, {self._checkpoints.newest}," if self._checkpoints.newest else "no checkpoint"
            raise Diverged(
                f"the training has diverged: {diverged}, at env step {self.env_steps:,}; {kept} has finite numbers; "
                "lower learning_rate or the scale of the rewards"
            ) from diverged
        except Exception:
            self._abandon()
            raise

    def _abandon(self) -> None:
        """Ends all nodes and the writing of checkpoints: neither may outlive this attempt, since another may begin."""
        self._cluster.abandon()
        self._checkpoints.abandon()

    def _run(self) -> bool:
        if not self._restored:
            self._send_first_weights()
        self._progress.meters.start_clock()
        while self.env_steps < self._config.total_env_steps and not self._stop():
            self._start_evaluation_if_due()
            self._start_collects()  # act, step, store: the workers push to the shards
            self._start_updates()  # sample, update, sync: as many as the pacer allows
            self._take_results()
            if self._progress.take_due("log"):
                self._write_row(self._progress.row())
                self._cluster.keep_spares()
            self._checkpoint_if_due()
        self._save_the_end()
        return self.env_steps >= self._config.total_env_steps

    def _send_first_weights(self) -> None:
        weights = self.newest_weights()  # by value: a lost learner must not look like a worker's fault
        for worker in self._supervisor.workers:
            try:
                self._supervisor.ask(worker, RolloutNode.set_weights, weights)
            except ComponentFailed as failure:
                self._recover(failure)

    def _start_collects(self) -> None:
        """Has the rollout workers collect blocks, in turn, as far as the pacer allows."""
        config, most = self._config, self._most_in_flight(self._limits.collects_in_flight)
        for _ in range(most):
            if self._all_blocks_ordered():
                return  # between rounds of workers, so that a resumed run begins with the same worker
            for worker_id, worker in enumerate(self._supervisor.workers):
                if self._in_flight.count(worker.component) >= most:
                    continue
                if not self._pacer.may_collect(self._in_flight.blocks_in_flight):
                    self._pacer.record_wait(to_insert=True)
                    return
                rate = epsilon(config.epsilon_settings, self.env_steps, worker_id, config.workers)
                self._start(worker, RolloutNode.collect, self._take_blocks, rate)

    def _all_blocks_ordered(self) -> bool:
        """Whether the blocks in flight make up what is left of the run."""
        expected = self._in_flight.blocks_in_flight * self._config.block_env_steps
        return self.env_steps + expected >= self._config.total_env_steps

    def _start_updates(self) -> None:
        """Starts updates, as far as the pacer allows; each message samples, updates, and publishes the weights."""
        while self._in_flight.count(LEARNER) < self._most_in_flight(self._limits.updates_in_flight):
            updates = self._pacer.updates_due(self._calls_of_a_message())
            if not updates:
                self._pacer.record_wait(to_insert=False)
                return
            self._pacer.record_sample(updates)
            config, take = self._config, self._progress.record_updates
            schedules = (config.learning_rate_at, config.importance_exponent_at, config.teacher_weight_at)
            rate, exponent, weight = (schedule(self.env_steps) for schedule in schedules)
            arguments = (updates, rate, exponent, weight)
            self._start(self._supervisor.learner, LearnerNode.update, take, *arguments, asked_for=updates)

    def _calls_of_a_message(self) -> int:
        """Calls of updates that a message may ask for; prioritised ones are one by one, as each sets priorities."""
        call_s = self._progress.update_s * self._config.updates_per_call
        if not call_s or self._config.replay == "prioritised":
            return 1
        return max(1, int(self._limits.message_s / call_s))

    def _start(
        self,
        placed: Placed[N],
        method: Callable[[N, *Ts], T],
        take: Callable[[T], None],
        *args: *Ts,
        asked_for: int = 0,
    ) -> None:
        """Starts a call of a component; `take` is called with the result once it is there.

        Args:
          placed: the component.
          method: what is called, with `args`.
          take: takes the result.
          args: see `method`.
          asked_for: updates.
        """
        ref = self._calls.start(placed.node, method, *args)
        call = PendingCall(method.__name__, placed.component, placed.incarnation, ref, take, asked_for)
        self._in_flight.add(call)

    def _start_evaluation_if_due(self) -> None:
        if self._checkpoints.is_wanted and self._is_evaluating():
            return  # a checkpoint waits for one evaluation, not for two
        if self._progress.take_due("eval"):
            self._start_evaluation()

    def _start_evaluation(self) -> None:
        seeds = list(range(EVAL_SEED, EVAL_SEED + self._config.eval_episodes))
        weights = by_reference(self._supervisor.weights_ref())
        ref = self._calls.run(evaluate, self._config.env, weights, seeds, self._config.decision_discount)
        take = partial(self._take_evaluation, self.env_steps)
        self._in_flight.add(PendingCall("eval", EVALUATOR, self._supervisor.incarnation(EVALUATOR), ref, take))

    def _is_evaluating(self) -> bool:
        return self._in_flight.count(EVALUATOR) > 0

    def _take_results(self) -> None:
        """Waits until a call in flight has ended, and takes the results of all that have."""
        if not self._in_flight and self._all_blocks_ordered():
            return self.settle()  # the workers report their last pushes only when they are asked
        if not self._in_flight:
            raise RuntimeError("nothing is in flight, and the pacer lets nothing start")
        ready = self._calls.wait(self._in_flight.refs, self._in_flight.time_left_s())
        late = self._in_flight.late(ready)
        for ref in ready:
            call = self._in_flight.take(ref)
            if call is not None:  # else its component has just been replaced
                self._take_result(call)
        for failure in late:
            self._recover(failure)

    def _take_result(self, call: PendingCall[T]) -> None:
        try:
            result = self._calls.get(call.ref)
        except CallFailed as failure:
            self._take_failure(call, failure.of(call.component, call.incarnation))
        except ComponentFailed as failure:  # of a component that the called one needs
            self._take_failure(call, failure)
        else:
            self._supervisor.record_success(call.component)
            call.take(result)

    def _take_failure(self, call: PendingCall[Any], failure: ComponentFailed) -> None:
        if call.component == LEARNER:
            self._pacer.undo_sample(call.updates)
        self._recover(failure)

    def _recover(self, failure: ComponentFailed) -> None:
        unreported = self._supervisor.recover(failure)
        self._progress.env_steps += unreported.env_steps
        if failure.component == EVALUATOR:
            self._start_evaluation()

    def _recover_if(self, failure: ComponentFailed | None) -> None:
        if failure is not None:
            self._recover(failure)

    def _take_blocks(self, reports: list[BlockReport]) -> None:
        for report in reports:
            self._in_flight.blocks[report.header.worker_id] -= 1
            self._progress.record_block(report)
            self._recover_if(self._supervisor.check_push(report))

    def _take_evaluation(self, env_steps: int, stats: EpisodeStats) -> None:
        metrics = {f"eval/{name}": value for name, value in as_metrics(summarise(stats)).items()}
        self._write_row(metrics, env_steps)

    def _write_row(self, metrics: dict[str, float], env_steps: int | None = None) -> None:
        row = Row(self.env_steps if env_steps is None else env_steps, int(time.time() * 1000), metrics)
        self._journal.append(row)
        self._observer.row(row)

    def settle(self) -> None:
        """Waits until nothing is in flight anywhere."""
        while self._in_flight:
            self._take_results()
        for worker in self._supervisor.workers:
            try:
                self._take_blocks(self._supervisor.ask(worker, RolloutNode.settle))
            except ComponentFailed as failure:
                self._recover(failure)  # its replacement has nothing in flight

    def _checkpoint_if_due(self) -> None:
        """Takes the last checkpoint's result; begins the next if it is due and no component has two calls in flight."""
        self._recover_if(self._checkpoints.poll())
        self._checkpoints.is_wanted |= self._progress.take_due("checkpoint")
        if self._checkpoint_is_next() and self._in_flight.most_of_one <= 1:
            self.begin_checkpoint()

    def _checkpoint_is_next(self) -> bool:
        """Whether a checkpoint is wanted and neither an earlier one nor an evaluation keeps it from beginning."""
        return self._checkpoints.may_begin and not self._is_evaluating()

    def _most_in_flight(self, limit: int) -> int:
        """Calls that a component may have in flight: `limit`, but 1 if a checkpoint is to begin soon."""
        return 1 if self._checkpoint_is_next() else limit

    def _save_the_end(self) -> None:
        """Writes a checkpoint of the end, again if a component fails meanwhile, or once a full disk has space."""
        self._recover_if(self._checkpoints.wait())
        self._checkpoints.is_wanted = self.saved is None
        deadline_s = time.monotonic() + DISK_TIMEOUT_S
        while self._checkpoints.is_wanted:
            self.begin_checkpoint()
            self._recover_if(self._checkpoints.wait())
            if self._checkpoints.lacks_space and time.monotonic() < deadline_s:
                time.sleep(DISK_PAUSE_S)
                self._checkpoints.is_wanted = True

    def begin_checkpoint(self) -> None:
        """Begins a checkpoint of the whole run once nothing is in flight; no other may be being written."""
        self.settle()
        try:
            self._checkpoints.begin()
        except ComponentFailed as failure:
            self._recover(failure)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Restores a checkpoint of this config; call before `run` (see `CheckpointManager.restore` for errors)."""
        self._checkpoints.restore(checkpoint)
        self._restored = True

    def lost(self, failure: ComponentFailed) -> RunLost:
        """Ends this attempt because of a failure outside the rounds of training (see `run` for other errors)."""
        self._abandon()
        try:
            self._supervisor.decide(failure)
        except RunLost as lost:
            return lost
        return RunLost(failure, self._supervisor.highest)

    def newest_weights(self) -> WeightsSnapshot:
        """The weights after the last update.

        Raises:
          ComponentFailed: they are gone with the learner.
        """
        return self._supervisor.ask(self._supervisor.learner, LearnerNode.weights)
