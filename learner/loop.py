"""The training loop: every hop from simulator to learned policy, in one process or over Ray actors.

The loop holds references and small reports; transitions go from rollout worker to shard to learner.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Protocol

from actors.evaluation.evaluator import evaluate
from actors.policy.network import WeightsSnapshot
from actors.rollout.exploration import epsilon
from actors.service.fault_policy import CallFailed, Component, ComponentFailed, ComponentKind, FaultTracker
from actors.service.messages import BlockReport, EpisodeStats
from actors.storage.uri import Location
from learner.checkpoints.checkpoint import Checkpoint
from learner.checkpoints.writer import CheckpointWriter
from learner.config import RunConfig
from learner.tracking.journal import Journal, Row
from learner.training.cluster import Cluster
from learner.training.counters import Progress
from learner.training.evaluation_summary import as_metrics, summarise
from learner.training.in_flight import Pending, UnderWay
from learner.training.ledger import Ledger
from learner.training.pacing import make_pacer
from learner.training.recovery import FaultObserver, Mender, RunLost
from learner.training.saver import LEARNER, SaveObserver, Saver

EVAL_SEED = 1_000_000_000
"""First seed of evaluations during training; training worlds draw theirs from other streams."""
EVALUATOR = Component(ComponentKind.EVALUATOR)


class Observer(FaultObserver, SaveObserver, Protocol):
    """What the loop tells its surroundings."""

    def row(self, row: Row) -> None:
        """A row of metrics was written."""
        ...


class TrainingLoop:
    """One run from its start or a checkpoint to its end.

    Args:
      config: the run.
      cluster: its parts.
      journal: where metrics go.
      checkpoints: folder or URL of the run's checkpoints.
      observer: is told of rows and checkpoints.
      stop: asked once a round; True ends the run early, with a checkpoint.
      recovery: decides about failed parts; remembers their failures in earlier attempts.
      keep_best: the best checkpoints that are kept beside the newest.
    """

    def __init__(
        self,
        config: RunConfig,
        cluster: Cluster,
        journal: Journal,
        checkpoints: Location,
        observer: Observer,
        stop: Callable[[], bool],
        recovery: FaultTracker | None = None,
        keep_best: int = 0,
    ) -> None:
        self._config = config
        self._cluster = cluster
        self._calls = cluster.calls
        self._journal = journal
        self._observer = observer
        self._stop = stop
        self._pacer = make_pacer(config, cluster.blocks_in_flight)
        self._ledger = Ledger(len(cluster.workers), cluster.capacities(config))
        self._progress = Progress(config, self._pacer, self._ledger)
        self._under_way = UnderWay(len(cluster.workers), cluster.deadline_s, cluster.start_deadline_s)
        self._mender = Mender(cluster, recovery or FaultTracker(), self._under_way, self._pacer, self._ledger, observer)
        checkpointer = CheckpointWriter(checkpoints, cluster.calls, cluster.queue_deadline_s)
        self._saver = Saver(config, keep_best, checkpointer, self._mender, self._progress, journal, observer)
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
        """The checkpoint of this very moment; None if it has not been written."""
        return self._saver.saved

    def run(self) -> bool:
        """Trains to `total_env_steps` or until stopped, and checkpoints the end.

        Returns:
          Whether the run is finished (else it was stopped).

        Raises:
          RuntimeError: nothing is under way and nothing may start.
          RunLost: a part failed that only a checkpoint can bring back.
          RunFailed: a part fails again and again.
          ComponentFailed: a part failed before the first round.
        """
        try:
            return self._run()
        except Exception:
            self._give_up()
            raise

    def _give_up(self) -> None:
        """Ends all parts, and what writes: neither must outlive its attempt, since another may begin at once."""
        self._cluster.abandon()
        self._saver.give_up()

    def _run(self) -> bool:
        if not self._restored:
            self._send_first_weights()
        self._progress.meters.start_clock()
        while self.env_steps < self._config.total_env_steps and not self._stop():
            if not (self._saver.is_wanted and self._evaluates()) and self._progress.is_due("eval"):
                self._start_evaluation()  # a checkpoint that is wanted waits for one that is under way, not for two
            self._start_collects()  # act, step, store: the workers push to the shards
            self._start_updates()  # sample, update, publish: when the pacer says so
            self._take_results()
            if self._progress.is_due("log"):
                self._write_row(self._progress.row())
            self._tend_checkpoints()  # a snapshot while nothing is under way; it is written meanwhile
        self._save_the_end()
        return self.env_steps >= self._config.total_env_steps

    def _send_first_weights(self) -> None:
        weights = self.newest_weights()  # here, so that a learner that is gone is not a worker's fault
        for worker in self._mender.workers:
            try:
                self._mender.ask(worker, "set_weights", weights)
            except ComponentFailed as failure:
                self._mend(failure)

    def _start_collects(self) -> None:
        config = self._config
        at_once = self._at_once(self._cluster.collects_in_flight)
        for _ in range(at_once):
            if self._all_is_ordered():
                return  # between rounds, so that a resumed run has every worker's turn where it would have been
            for part in self._mender.workers:
                worker_id = part.number
                if self._under_way.collects[worker_id] >= at_once:
                    continue
                if not self._pacer.may_collect(self._under_way.blocks_in_flight):
                    self._pacer.waited(to_insert=True)
                    return
                rate = epsilon(config.epsilon_settings, self.env_steps, worker_id, config.workers)
                self._start(part, "collect", 0, rate)

    def _all_is_ordered(self) -> bool:
        """Whether the blocks under way make up what is left of the run."""
        expected = self._under_way.blocks_in_flight * self._config.block_env_steps
        return self.env_steps + expected >= self._config.total_env_steps

    def _start_updates(self) -> None:
        while self._under_way.count("update") < self._at_once(self._cluster.updates_in_flight):
            updates = self._pacer.updates_due()
            if not updates:
                self._pacer.waited(to_insert=False)
                return
            self._pacer.sampling(updates)
            now, config = self.env_steps, self._config
            rates = config.learning_rate_at(now), config.importance_exponent_at(now)
            self._start(LEARNER, "update", updates, updates, *rates)

    def _start_evaluation(self) -> None:
        seeds = list(range(EVAL_SEED, EVAL_SEED + self._config.eval_episodes))
        ref = self._calls.run(evaluate, self._config.env, self._mender.weights_ref(), seeds)
        self._under_way.add(ref, Pending("eval", EVALUATOR, self._mender.incarnation(EVALUATOR), self.env_steps))

    def _start(self, part: Component, method: str, amount: int, *args: Any) -> None:
        ref = self._calls.start(self._mender.node(part), method, *args)
        self._under_way.add(ref, Pending(method, part, self._mender.incarnation(part), amount))

    def _take_results(self) -> None:
        if not self._under_way and self._all_is_ordered():
            return self.settle()  # the workers report their last pushes only when they are asked
        if not self._under_way:
            raise RuntimeError("nothing is under way and pacing lets nothing start")
        ready = self._calls.wait(self._under_way.refs, self._under_way.patience_s())
        late = self._under_way.late(ready)
        for ref in ready:
            pending = self._under_way.take(ref)
            if pending is None:
                continue  # its part was replaced a moment ago
            try:
                result = self._calls.get(ref)
            except CallFailed as error:
                self._take_failure(pending, pending.failed(error))
            except ComponentFailed as failure:  # of a part that the called one needs
                self._take_failure(pending, failure)
            else:
                self._take_result(pending, result)
        for failed in late:
            self._mend(failed)

    def _take_result(self, pending: Pending, result: Any) -> None:
        self._mender.worked(pending.component)
        if pending.kind == "collect":
            self._take_blocks(result)
        elif pending.kind == "update":
            self._progress.take_updates(result, pending.amount)
        else:
            self._take_evaluation(result, pending.amount)

    def _take_failure(self, pending: Pending, failure: ComponentFailed) -> None:
        if pending.kind == "update":
            self._pacer.not_sampled(pending.amount)
        self._mend(failure)

    def _mend(self, failure: ComponentFailed) -> None:
        unreported = self._mender.mend(failure)
        self._progress.env_steps += unreported.env_steps
        if failure.component == EVALUATOR:
            self._start_evaluation()

    def _take_blocks(self, reports: list[BlockReport]) -> None:
        for report in reports:
            self._under_way.blocks[report.header.worker_id] -= 1
            self._progress.take_block(report)
            failure = self._mender.check_push(report)
            if failure is not None:
                self._mend(failure)

    def _take_evaluation(self, stats: EpisodeStats, env_steps: int) -> None:
        metrics = {f"eval/{name}": value for name, value in as_metrics(summarise(stats)).items()}
        self._write_row(metrics, env_steps)

    def _write_row(self, metrics: dict[str, float], env_steps: int | None = None) -> None:
        row = Row(self.env_steps if env_steps is None else env_steps, int(time.time() * 1000), metrics)
        self._journal.append(row)
        self._observer.row(row)

    def settle(self) -> None:
        """Waits until nothing is under way anywhere."""
        while self._under_way:
            self._take_results()
        for worker in self._mender.workers:
            try:
                self._take_blocks(self._mender.ask(worker, "settle"))
            except ComponentFailed as failure:
                self._mend(failure)  # a new worker has nothing under way

    def _evaluates(self) -> bool:
        return self._under_way.count("eval") > 0

    def _tend_checkpoints(self) -> None:
        """Tells of a checkpoint that has ended; begins one that is due, once none and no evaluation is under way."""
        self._mend_if(self._saver.poll())
        self._saver.is_wanted |= self._progress.is_due("checkpoint")
        if self._saves_soon() and max(self._under_way.count("update"), *self._under_way.collects) <= 1:
            self.checkpoint()

    def _saves_soon(self) -> bool:
        """Whether a checkpoint begins once no part has more than one call under way, which it waits for."""
        return self._saver.may_begin and not self._evaluates()

    def _at_once(self, in_flight: int) -> int:
        """Calls that one part may have under way, of which there are `in_flight` unless a checkpoint is to begin."""
        return 1 if self._saves_soon() else in_flight

    def _save_the_end(self) -> None:
        """Writes a checkpoint of this moment, again where a part fails meanwhile."""
        self._mend_if(self._saver.wait())
        self._saver.is_wanted = self.saved is None
        while self._saver.is_wanted:
            self.checkpoint()
            self._mend_if(self._saver.wait())

    def checkpoint(self) -> None:
        """Begins a checkpoint of the whole run at a moment when nothing is under way; none may be being written."""
        self.settle()
        try:
            self._saver.begin()
        except ComponentFailed as failure:
            self._mend(failure)

    def _mend_if(self, failure: ComponentFailed | None) -> None:
        if failure is not None:
            self._mend(failure)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Takes up a checkpoint of this config; call before `run` (see `Saver.restore` for errors)."""
        self._saver.restore(checkpoint)
        self._restored = True

    def lost(self, failure: ComponentFailed) -> RunLost:
        """Ends this attempt because of a failure outside of the rounds of training (see `run` for other errors)."""
        self._give_up()
        try:
            self._mender.decide(failure)
        except RunLost as lost:
            return lost
        return RunLost(failure, self._mender.highest)

    def newest_weights(self) -> WeightsSnapshot:
        """The weights that the last update made.

        Raises:
          ComponentFailed: they are gone with the learner.
        """
        weights: WeightsSnapshot = self._mender.ask(LEARNER, "weights")
        return weights
