"""Takes the state of a run apart into a checkpoint, and puts it together again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from actors.rollout.node import RolloutNode
from actors.service.fault_policy import Component, ComponentFailed, ComponentKind
from actors.service.rpc import Placed
from actors.storage.full_disk import is_full
from actors.storage.uri import Location, join_location
from learner.checkpoints.checkpoint import Checkpoint, Retention
from learner.checkpoints.retention import Score, scores_of
from learner.checkpoints.writer import Checkpointable, CheckpointResult, CheckpointWriter, RunPosition
from learner.config import RunConfig, to_dict
from learner.tracking.journal import Journal
from learner.training.counters import Progress
from learner.training.recovery import Supervisor
from learner.update.learner_node import LearnerNode


class CheckpointObserver(Protocol):
    """Hears of checkpoints."""

    def checkpoint(self, folder: Location, journal_offset: int) -> None:
        """A checkpoint is complete; it covers the journal up to the offset."""
        ...

    def checkpoint_failed(self, env_steps: int, reason: str) -> None:
        """The checkpoint of these env steps could not be written; the run goes on."""
        ...


class CheckpointManager:
    """Begins the checkpoints of a run, one at a time, takes their results, and restores from one.

    Args:
      config: the run.
      keep_best: how many of the best checkpoints are kept beside the newest.
      writer: writes them in the background.
      supervisor: calls the run's components.
      progress: the driver's counters.
      journal: the run's rows.
      observer: hears of checkpoints.
    """

    def __init__(
        self,
        config: RunConfig,
        keep_best: int,
        writer: CheckpointWriter,
        supervisor: Supervisor,
        progress: Progress,
        journal: Journal,
        observer: CheckpointObserver,
    ) -> None:
        self._config = config
        self._keep_best = keep_best
        self._writer = writer
        self._supervisor = supervisor
        self._progress = progress
        self._journal = journal
        self._observer = observer
        self._scores: list[Score] = []
        self._scored_to = 0
        """Byte of the journal up to which rows have been searched for scores: the journal of hours is long."""
        self._saved: Location | None = None
        self._saved_at: tuple[int, int] | None = None
        self.is_wanted = False
        """Whether a checkpoint is to begin as soon as one can."""
        self.lacks_space = False
        """Whether the last checkpoint failed because a disk was full."""

    @property
    def saved(self) -> Location | None:
        """The checkpoint of the present env steps and updates; None if there is none."""
        return self._saved if self._saved_at == (self._progress.env_steps, self._progress.updates) else None

    @property
    def newest(self) -> Location | None:
        """The newest checkpoint that this session has written or restored; None if there is none."""
        return self._saved

    @property
    def may_begin(self) -> bool:
        """Whether a checkpoint is wanted, and none is being written."""
        return self.is_wanted and not self._writer.is_busy

    def begin(self) -> None:
        """Begins a checkpoint; no call may be in flight.

        Raises:
          ComponentFailed: a component could not begin to save itself; the checkpoint stays wanted.
        """
        position = RunPosition(self._progress.env_steps, self._progress.updates, self._journal.length)
        draft = self._writer.draft(position.env_steps)
        components = self._components()
        try:
            state = self._save(components, draft, position)
        except ComponentFailed as failure:
            self.is_wanted = True
            others = [placed for placed in components if placed.component != failure.component]
            self._writer.abort(position, others, failure)
            raise
        self.is_wanted = False
        self._writer.begin(position, draft, state, components, lambda: self._seal(position))

    def _components(self) -> list[Placed[Checkpointable]]:
        """The learner, then the rollout workers."""
        return [self._supervisor.learner, *self._supervisor.workers]

    def _save(
        self, components: Sequence[Placed[Checkpointable]], draft: Location, position: RunPosition
    ) -> dict[str, Any]:
        """Has all components begin to save themselves to `draft`; returns the rest of the run's state, for JSON."""
        locations = [(placed, _location(draft, placed.component)) for placed in components]
        learner, *workers = self._supervisor.ask_all(Checkpointable.save, locations)
        return self._progress.get_state() | {
            "config": to_dict(self._config),
            "incarnation": self._supervisor.highest,
            "journal_offset": position.journal_offset,
            "learner": learner,
            "workers": workers,
        }

    def _seal(self, position: RunPosition) -> Retention:
        """Makes the journal durable before a checkpoint counts on it; tells which checkpoints to keep."""
        self._journal.sync()
        self._scores += scores_of(self._journal.rows(self._scored_to, position.journal_offset))
        self._scored_to = position.journal_offset
        return Retention(self._config.keep_checkpoints, self._keep_best, list(self._scores))

    def poll(self) -> ComponentFailed | None:
        """Takes the result of a checkpoint that has ended; the caller recovers from the failure that is returned."""
        return self._take(self._writer.poll())

    def wait(self) -> ComponentFailed | None:
        """As `poll`, once the checkpoint that is being written has ended."""
        return self._take(self._writer.wait())

    def abandon(self) -> None:
        """Ends what is being written (see `CheckpointWriter.abandon`)."""
        self._writer.abandon()

    def _take(self, result: CheckpointResult | None) -> ComponentFailed | None:
        if result is None:
            return None
        position = result.position
        self.lacks_space = result.location is None and is_full(result.error or "")
        if result.location is None:
            self._observer.checkpoint_failed(position.env_steps, result.error or "")
            self.is_wanted |= result.failure is not None  # a failed storage is not tried again before the next is due
            return result.failure
        self._observer.checkpoint(result.location, position.journal_offset)
        self._saved, self._saved_at = result.location, (position.env_steps, position.updates)
        return None

    def restore(self, checkpoint: Checkpoint) -> None:
        """Restores the run from a checkpoint of its config.

        Raises:
          ValueError: the files do not fit this run.
          ComponentFailed: a component failed.
        """
        folder, state = checkpoint
        learner, workers = self._supervisor.learner, self._supervisor.workers
        self._supervisor.ask(learner, LearnerNode.load, _location(folder, learner.component), state["learner"])
        for worker_id, worker in enumerate(workers):
            own = state["workers"][worker_id]
            self._supervisor.ask(worker, RolloutNode.load, _location(folder, worker.component), own)
        self._progress.set_state(state)
        self._saved, self._saved_at = folder, (self._progress.env_steps, self._progress.updates)


def _location(folder: Location, component: Component) -> Location:
    """Where a component saves itself: a rollout worker to a file, the learner to several in the folder itself."""
    if component.kind is ComponentKind.LEARNER:
        return folder
    return join_location(folder, f"worker-{component.number}.safetensors")
