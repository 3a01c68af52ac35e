"""The training loop: every hop from simulator to learned policy, in one process or over Ray actors.

The loop holds references and small reports; transitions go from rollout worker to shard to learner.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from actors.calls import Ref
from actors.evaluator import evaluate, evaluate_in_parts
from actors.exploration import epsilon
from actors.locations import Location, inside
from actors.network import WeightsSnapshot
from actors.transitions import BlockReport, EpisodeStats
from learner.checkpoint import Checkpoint, Keep
from learner.checkpointer import Checkpointer, Ended, Moment
from learner.cluster import Cluster
from learner.config import RunConfig, to_dict
from learner.journal import Journal, Row
from learner.meters import Meters
from learner.node import UpdateReport
from learner.pacing import PacingState, make_pacer
from learner.results import as_metrics, summarise
from learner.retention import scores_of

EVAL_SEED = 1_000_000_000
"""First seed of evaluations during training; training worlds draw theirs from other streams."""


class Observer(Protocol):
    """What the loop tells its surroundings."""

    def row(self, row: Row) -> None:
        """A row of metrics was written."""
        ...

    def checkpoint(self, folder: Location, journal_offset: int) -> None:
        """A checkpoint is whole; rows up to the offset are covered by it."""
        ...

    def checkpoint_failed(self, env_steps: int, reason: str) -> None:
        """The checkpoint of these env steps could not be written; the run goes on."""
        ...


class Pending(NamedTuple):
    """A call under way: its kind, and what is needed to take its result."""

    kind: str
    worker_id: int
    amount: int


class TrainingLoop:
    """One run from its start or a checkpoint to its end.

    Args:
      config: the run.
      cluster: its parts.
      journal: where metrics go.
      checkpoints: folder or URL of the run's checkpoints.
      observer: is told of rows and checkpoints.
      stop: asked once a round; True ends the run early, with a checkpoint.
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
        keep_best: int = 0,
    ) -> None:
        self._config = config
        self._cluster = cluster
        self._calls = cluster.calls
        self._journal = journal
        self._checkpointer = Checkpointer(checkpoints, cluster.calls)
        self._keep_best = keep_best
        self._observer = observer
        self._stop = stop
        self._pacer = make_pacer(config, cluster.blocks_in_flight)
        self._meters = Meters()
        self._pending: dict[Ref, Pending] = {}
        self._collects = [0] * len(cluster.workers)
        self._blocks_in_flight = 0
        self._weights: Ref = None
        self._incarnation = 0
        self.env_steps = 0
        self.updates = 0
        self._saved: Location | None = None
        self._saved_at: tuple[int, int] | None = None
        self._due = {"log": config.log_every_env_steps, "eval": config.eval_every_env_steps}
        self._due["checkpoint"] = config.checkpoint_every_env_steps
        self._wants_checkpoint = False

    def run(self) -> bool:
        """Trains to `total_env_steps` or until stopped, and checkpoints the end.

        Returns:
          Whether the run is finished (else it was stopped).

        Raises:
          RuntimeError: nothing is under way and nothing may start.
        """
        try:
            return self._run()
        except Exception:
            self._checkpointer.wait()  # what writes must not outlive its run: another attempt may begin at once
            raise

    def _run(self) -> bool:
        if self._weights is None:
            self._send_first_weights()
        self._meters.start_clock()
        while self.env_steps < self._config.total_env_steps and not self._stop():
            if not self._evaluates_before_checkpoint() and self._is_due("eval", self._config.eval_every_env_steps):
                self._start_evaluation()  # after the last round's checkpoint, which would wait for it
            self._start_collects()  # act, step, store: the workers push to the shards
            self._start_updates()  # sample, update, publish: when the pacer says so
            self._take_results()
            if self._is_due("log", self._config.log_every_env_steps):
                self._write_row(self._meters.row(self._replay_size(), self._pacer.ratio()))
            self._tend_checkpoints()
        self._take_checkpoint(self._checkpointer.wait())
        if self.saved is None:
            self.checkpoint()
            self._take_checkpoint(self._checkpointer.wait())
        return self.env_steps >= self._config.total_env_steps

    def _send_first_weights(self) -> None:
        self._weights = self._get(self._cluster.learner, "weights")[0]
        for ref in [self._calls.start(worker, "set_weights", self._weights) for worker in self._cluster.workers]:
            self._calls.get(ref)

    def _get(self, node: Any, method: str, *args: Any) -> Any:
        return self._calls.get(self._calls.start(node, method, *args))

    def _start_collects(self) -> None:
        config = self._config
        for _ in range(self._cluster.collects_in_flight):
            for worker_id, worker in enumerate(self._cluster.workers):
                if self._collects[worker_id] >= self._cluster.collects_in_flight:
                    continue
                if not self._pacer.may_collect(self._blocks_in_flight):
                    self._pacer.waited(to_insert=True)
                    return
                rate = epsilon(config.epsilon_settings, self.env_steps, worker_id, config.workers)
                self._add(self._calls.start(worker, "collect", rate), Pending("collect", worker_id, 0))
                self._collects[worker_id] += 1
                self._blocks_in_flight += 1

    def _start_updates(self) -> None:
        under_way = sum(pending.kind == "update" for pending in self._pending.values())
        while under_way < self._cluster.updates_in_flight:
            updates = self._pacer.updates_due()
            if not updates:
                return
            self._pacer.sampling(updates)
            rate = self._config.learning_rate_at(self.env_steps)
            self._add(self._calls.start(self._cluster.learner, "update", updates, rate), Pending("update", 0, updates))
            under_way += 1

    def _start_evaluation(self) -> None:
        seeds = list(range(EVAL_SEED, EVAL_SEED + self._config.eval_episodes))
        ref = self._calls.run(evaluate, self._config.env, self._weights, seeds)
        self._add(ref, Pending("eval", 0, self.env_steps))

    def _add(self, ref: Ref, pending: Pending) -> None:
        self._pending[ref] = pending

    def _take_results(self) -> None:
        if not self._pending:
            raise RuntimeError("nothing is under way and pacing lets nothing start")
        for ref in self._calls.wait(list(self._pending)):
            pending = self._pending.pop(ref)
            result = self._calls.get(ref)
            if pending.kind == "collect":
                self._collects[pending.worker_id] -= 1
                self._take_blocks(result)
            elif pending.kind == "update":
                self._take_updates(result, pending.amount)
            else:
                self._take_evaluation(result, pending.amount)

    def _take_blocks(self, reports: list[BlockReport]) -> None:
        for report in reports:
            self._blocks_in_flight -= 1
            self._pacer.inserted(report.stored)
            self._meters.take_block(report)
            self.env_steps += report.header.env_steps

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

    def _replay_size(self) -> int:
        return min(self._pacer.state.inserted, self._config.replay_capacity)

    def _is_due(self, what: str, every: int) -> bool:
        """Whether `env_steps` has passed the next multiple of `every`; moves on to the one after."""
        if self.env_steps < self._due[what]:
            return False
        self._due[what] = (self.env_steps // every + 1) * every
        return True

    def settle(self) -> None:
        """Waits until nothing is under way anywhere."""
        while self._pending:
            self._take_results()
        for worker in self._cluster.workers:
            self._take_blocks(self._get(worker, "settle"))

    @property
    def saved(self) -> Location | None:
        """The checkpoint of this very moment; None if it has not been written."""
        return self._saved if self._saved_at == (self.env_steps, self.updates) else None

    def _evaluates(self) -> bool:
        return any(pending.kind == "eval" for pending in self._pending.values())

    def _evaluates_before_checkpoint(self) -> bool:
        """Whether a checkpoint waits for an evaluation to end, so that no other may begin."""
        return self._wants_checkpoint and self._evaluates()

    def _tend_checkpoints(self) -> None:
        """Tells of a checkpoint that has ended; begins one that is due, once none and no evaluation is under way."""
        self._take_checkpoint(self._checkpointer.poll())
        self._wants_checkpoint |= self._is_due("checkpoint", self._config.checkpoint_every_env_steps)
        if self._wants_checkpoint and not self._checkpointer.is_busy and not self._evaluates():
            self.checkpoint()

    def _take_checkpoint(self, ended: Ended | None) -> None:
        if ended is None:
            return
        if ended.location is None:
            self._observer.checkpoint_failed(ended.moment.env_steps, ended.error or "")
        else:
            self._observer.checkpoint(ended.location, ended.moment.journal_offset)
            self._saved, self._saved_at = ended.location, (ended.moment.env_steps, ended.moment.updates)

    def checkpoint(self) -> None:
        """Begins a checkpoint of the whole run at a moment when nothing is under way; none may be being written."""
        self.settle()
        self._wants_checkpoint = False
        moment = Moment(self.env_steps, self.updates, self._journal.flush())
        draft = self._checkpointer.draft(self.env_steps)
        state = self._save(draft, moment.journal_offset)
        self._checkpointer.begin(moment, draft, state, self._nodes(), lambda: self._seal(moment))

    def _seal(self, moment: Moment) -> Keep:
        """Makes the journal durable before a checkpoint counts on it; tells which checkpoints stay."""
        self._journal.sync()
        scores = scores_of(self._journal.rows(0, moment.journal_offset))
        return Keep(self._config.keep_checkpoints, self._keep_best, scores)

    def _nodes(self) -> dict[str, Any]:
        workers = {f"rollout worker {i}": worker for i, worker in enumerate(self._cluster.workers)}
        return {"the learner": self._cluster.learner, **workers}

    def _save(self, folder: Location, journal_offset: int) -> dict[str, Any]:
        learner = self._calls.start(self._cluster.learner, "save", folder)
        workers = [
            self._calls.start(worker, "save", inside(folder, f"worker-{i}.safetensors"))
            for i, worker in enumerate(self._cluster.workers)
        ]
        return {
            "config": to_dict(self._config),
            "env_steps": self.env_steps,
            "updates": self.updates,
            "incarnation": self._incarnation,
            "pacing": self._pacer.state._asdict(),
            "meters": self._meters.get_state(),
            "due": dict(self._due),
            "journal_offset": journal_offset,
            "learner": self._calls.get(learner),
            "workers": [self._calls.get(worker) for worker in workers],
        }

    def restore(self, checkpoint: Checkpoint) -> None:
        """Takes up a checkpoint of this config; call before `run`.

        Raises:
          ValueError: its files do not fit this run.
        """
        folder, state = checkpoint
        self._weights = self._get(self._cluster.learner, "load", folder, state["learner"])[0]
        for i, worker in enumerate(self._cluster.workers):
            self._get(worker, "load", inside(folder, f"worker-{i}.safetensors"), state["workers"][i])
        self.env_steps, self.updates = state["env_steps"], state["updates"]
        self._incarnation = state["incarnation"] + 1
        self._pacer.state = PacingState(**state["pacing"])
        self._meters.set_state(state["meters"])
        self._due = {what: int(state["due"][what]) for what in self._due}
        self._saved, self._saved_at = folder, (self.env_steps, self.updates)

    def final_evaluation(self) -> EpisodeStats:
        """Plays the newest weights over `final_eval_episodes`, in parallel tasks."""
        first = self._config.final_eval_first_seed
        seeds = list(range(first, first + self._config.final_eval_episodes))
        return evaluate_in_parts(self._calls, self._config.env, self._weights, seeds, self._cluster.eval_tasks)

    def newest_weights(self) -> WeightsSnapshot:
        """The weights that `final_evaluation` plays."""
        weights: WeightsSnapshot = self._calls.get(self._weights)
        return weights
