"""The training loop: every hop from simulator to learned policy, in one process or over Ray actors.

The loop holds references and small reports; transitions go from rollout worker to shard to learner.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from actors.calls import Ref
from actors.evaluator import evaluate, evaluate_in_parts
from actors.exploration import epsilon
from actors.faults import CallFailed, Part, PartFailed, PartKind, Recovery, RunFailed
from actors.network import WeightsSnapshot
from actors.transitions import BlockReport, EpisodeStats
from learner.checkpoint import Checkpoint, keep_newest, write_checkpoint
from learner.cluster import Cluster
from learner.config import RunConfig, config_hash
from learner.journal import ACCOUNT, Journal, Row
from learner.ledger import Ledger
from learner.mending import FaultObserver, Mender, RunLost
from learner.meters import Meters
from learner.node import UpdateReport
from learner.pacing import PacingState, make_pacer
from learner.results import as_metrics, summarise
from learner.under_way import Pending, UnderWay

EVAL_SEED = 1_000_000_000
"""First seed of evaluations during training; training worlds draw theirs from other streams."""


LEARNER, EVALUATOR = Part(PartKind.LEARNER), Part(PartKind.EVALUATOR)


class Observer(FaultObserver, Protocol):
    """What the loop tells its surroundings."""

    def row(self, row: Row) -> None:
        """A row of metrics was written."""
        ...

    def checkpoint(self, folder: Path, journal_offset: int) -> None:
        """A checkpoint is whole; rows up to the offset are covered by it."""
        ...


class TrainingLoop:
    """One run from its start or a checkpoint to its end.

    Args:
      config: the run.
      cluster: its parts.
      journal: where metrics go.
      checkpoints: folder of the run's checkpoints.
      observer: is told of rows and checkpoints.
      stop: asked once a round; True ends the run early, with a checkpoint.
      recovery: decides about failed parts; remembers their failures in earlier attempts.
    """

    def __init__(
        self,
        config: RunConfig,
        cluster: Cluster,
        journal: Journal,
        checkpoints: Path,
        observer: Observer,
        stop: Callable[[], bool],
        recovery: Recovery | None = None,
    ) -> None:
        self._config = config
        self._cluster = cluster
        self._calls = cluster.calls
        self._journal = journal
        self._checkpoints = checkpoints
        self._observer = observer
        self._stop = stop
        self._pacer = make_pacer(config, cluster.blocks_in_flight)
        self._meters = Meters()
        self._ledger = Ledger(len(cluster.workers), cluster.capacities(config))
        self._under_way = UnderWay(len(cluster.workers), cluster.deadline_s, cluster.start_deadline_s)
        self._mender = Mender(cluster, recovery or Recovery(), self._under_way, self._pacer, self._ledger, observer)
        self._weights: Ref = None
        self.env_steps = 0
        self.updates = 0
        self._saved_at: tuple[int, int] | None = None
        self._due = {"log": config.log_every_env_steps, "eval": config.eval_every_env_steps}
        self._due["checkpoint"] = config.checkpoint_every_env_steps

    def run(self) -> bool:
        """Trains to `total_env_steps` or until stopped, and checkpoints the end.

        Returns:
          Whether the run is finished (else it was stopped).

        Raises:
          RuntimeError: nothing is under way and nothing may start.
          RunLost: a part failed that only a checkpoint can bring back.
          RunFailed: a part fails again and again.
          PartFailed: a part failed before the first round.
        """
        if self._weights is None:
            self._send_first_weights()
        self._meters.start_clock()
        while self.env_steps < self._config.total_env_steps and not self._stop():
            if self._is_due("eval", self._config.eval_every_env_steps):
                self._start_evaluation()  # after the last round's checkpoint, which would wait for it
            self._start_collects()  # act, step, store: the workers push to the shards
            self._start_updates()  # sample, update, publish: when the pacer says so
            self._take_results()
            if self._is_due("log", self._config.log_every_env_steps):
                self._write_row(self._training_row())
            if self._is_due("checkpoint", self._config.checkpoint_every_env_steps):
                self.checkpoint()
        if self._saved_at != (self.env_steps, self.updates):
            self.checkpoint()
        return self.env_steps >= self._config.total_env_steps

    def _send_first_weights(self) -> None:
        self._weights = self._mender.ask(LEARNER, "weights")[0]
        for worker in self._workers():
            try:
                self._mender.ask(worker, "set_weights", self._weights)
            except PartFailed as failure:
                self._mend(failure)

    def _workers(self) -> list[Part]:
        return [Part(PartKind.WORKER, worker_id) for worker_id in range(len(self._cluster.workers))]

    def _start_collects(self) -> None:
        config = self._config
        for _ in range(self._cluster.collects_in_flight):
            for part in self._workers():
                worker_id = part.number
                if self._under_way.collects[worker_id] >= self._cluster.collects_in_flight:
                    continue
                if not self._pacer.may_collect(self._under_way.blocks_in_flight):
                    self._pacer.waited(to_insert=True)
                    return
                rate = epsilon(config.epsilon_settings, self.env_steps, worker_id, config.workers)
                self._start(part, "collect", 0, rate)

    def _start_updates(self) -> None:
        while self._under_way.count("update") < self._cluster.updates_in_flight:
            updates = self._pacer.updates_due()
            if not updates:
                self._pacer.waited(to_insert=False)
                return
            self._pacer.sampling(updates)
            rate, exponent = (
                self._config.learning_rate_at(self.env_steps),
                self._config.importance_exponent_at(self.env_steps),
            )
            self._start(LEARNER, "update", updates, updates, rate, exponent)

    def _start_evaluation(self) -> None:
        seeds = list(range(EVAL_SEED, EVAL_SEED + self._config.eval_episodes))
        ref = self._calls.run(evaluate, self._config.env, self._weights, seeds)
        self._under_way.add(ref, Pending("eval", EVALUATOR, self._mender.incarnation(EVALUATOR), self.env_steps))

    def _start(self, part: Part, method: str, amount: int, *args: Any) -> None:
        ref = self._calls.start(self._mender.node(part), method, *args)
        self._under_way.add(ref, Pending(method, part, self._mender.incarnation(part), amount))

    def _take_results(self) -> None:
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
            except PartFailed as failure:  # of a part that the called one needs
                self._take_failure(pending, failure)
            else:
                self._take_result(pending, result)
        for failed in late:
            self._mend(failed)

    def _take_result(self, pending: Pending, result: Any) -> None:
        self._mender.worked(pending.part)
        if pending.kind == "collect":
            self._take_blocks(result)
        elif pending.kind == "update":
            self._take_updates(result, pending.amount)
        else:
            self._take_evaluation(result, pending.amount)

    def _take_failure(self, pending: Pending, failure: PartFailed) -> None:
        if pending.kind == "update":
            self._pacer.not_sampled(pending.amount)
        self._mend(failure)

    def _mend(self, failure: PartFailed) -> None:
        unreported = self._mender.mend(failure, self._weights)
        self.env_steps += unreported.env_steps
        if failure.part == EVALUATOR:
            self._start_evaluation()

    def _take_blocks(self, reports: list[BlockReport]) -> None:
        for report in reports:
            self._under_way.blocks[report.header.worker_id] -= 1
            self._pacer.inserted(self._ledger.take(report))
            self._meters.take_block(report)
            self.env_steps += report.header.env_steps
            failure = self._mender.check_push(report)
            if failure is not None:
                self._mend(failure)

    def _take_updates(self, report: UpdateReport, updates: int) -> None:
        self._meters.take_updates(report, updates)
        self.updates = report.version
        self._weights = report.weights[0]

    def _take_evaluation(self, stats: EpisodeStats, env_steps: int) -> None:
        metrics = {f"eval/{name}": value for name, value in as_metrics(summarise(stats)).items()}
        self._write_row(metrics, env_steps)

    def _write_row(self, metrics: dict[str, float], env_steps: int | None = None) -> None:
        row = Row(self.env_steps if env_steps is None else env_steps, int(time.time() * 1000), metrics)
        self._journal.append(row)
        self._observer.row(row)

    def _training_row(self) -> dict[str, float]:
        row = self._meters.row(self._ledger.replay_size, self._pacer.ratio()) | self._ledger.row()
        pacing = self._pacer.state
        counts = {
            "sampled": pacing.sampled,
            "updates": self.updates,
            "waits_to_insert": pacing.waits_to_insert,
            "waits_to_sample": pacing.waits_to_sample,
        }
        return row | {f"{ACCOUNT}{name}": float(count) for name, count in counts.items()}

    def _is_due(self, what: str, every: int) -> bool:
        """Whether `env_steps` has passed the next multiple of `every`; moves on to the one after."""
        if self.env_steps < self._due[what]:
            return False
        self._due[what] = (self.env_steps // every + 1) * every
        return True

    def settle(self) -> None:
        """Waits until nothing is under way anywhere."""
        while self._under_way:
            self._take_results()
        for worker in self._workers():
            try:
                self._take_blocks(self._mender.ask(worker, "settle"))
            except PartFailed as failure:
                self._mend(failure)  # a new worker has nothing under way

    def checkpoint(self) -> Path:
        """Writes a checkpoint of the whole run at a moment when nothing is under way."""
        while True:
            try:
                return self._checkpoint()
            except PartFailed as failure:
                self._mend(failure)

    def _checkpoint(self) -> Path:
        self.settle()
        offset = self._journal.sync()
        folder = write_checkpoint(self._checkpoints, self.env_steps, lambda part: self._save(part, offset))
        keep_newest(self._checkpoints, self._config.keep_checkpoints)
        self._observer.checkpoint(folder, offset)
        self._saved_at = (self.env_steps, self.updates)
        return folder

    def _save(self, folder: Path, journal_offset: int) -> dict[str, Any]:
        learner = self._mender.ask(LEARNER, "save", folder)
        workers = [
            self._mender.ask(worker, "save", folder / f"worker-{worker.number}.safetensors")
            for worker in self._workers()
        ]
        return {
            "config_hash": config_hash(self._config),
            "env_steps": self.env_steps,
            "updates": self.updates,
            "incarnation": self._mender.highest,
            "pacing": self._pacer.state._asdict(),
            "meters": self._meters.get_state(),
            "ledger": self._ledger.get_state(),
            "due": self._due,
            "journal_offset": journal_offset,
            "learner": learner,
            "workers": workers,
        }

    def restore(self, checkpoint: Checkpoint) -> None:
        """Takes up a checkpoint of this config; call before `run`.

        Raises:
          ValueError: its files do not fit this run.
        """
        folder, state = checkpoint
        self._weights = self._mender.ask(LEARNER, "load", folder, state["learner"])[0]
        for worker in self._workers():
            i = worker.number
            self._mender.ask(worker, "load", folder / f"worker-{i}.safetensors", state["workers"][i])
        self.env_steps, self.updates = state["env_steps"], state["updates"]
        self._pacer.state = PacingState(**state["pacing"])
        self._meters.set_state(state["meters"])
        self._ledger.set_state(state["ledger"])
        self._due = dict(state["due"])

    def lost(self, failure: PartFailed) -> RunLost:
        """Ends this attempt because of a failure outside of the rounds of training (see `run` for other errors)."""
        try:
            self._mender.decide(failure)
        except RunLost as lost:
            return lost
        return RunLost(failure, self._mender.highest)

    def final_evaluation(self, weights: WeightsSnapshot) -> EpisodeStats:
        """Plays `weights` over `final_eval_episodes`, in parallel tasks that need none of the run's parts."""
        first = self._config.final_eval_first_seed
        seeds = list(range(first, first + self._config.final_eval_episodes))
        shared = self._calls.put(weights)
        try:
            return evaluate_in_parts(self._calls, self._config.env, shared, seeds, self._cluster.eval_tasks)
        except CallFailed as failure:
            raise RunFailed(f"the evaluation at the end {failure.fault} again and again: {failure.reason}") from failure

    def newest_weights(self) -> WeightsSnapshot:
        """The weights that the last update made.

        Raises:
          PartFailed: they are gone with the learner.
        """
        try:
            weights: WeightsSnapshot = self._calls.get(self._weights)
        except CallFailed as failure:
            raise PartFailed(LEARNER, self._mender.incarnation(LEARNER), failure.fault, failure.reason) from failure
        return weights
