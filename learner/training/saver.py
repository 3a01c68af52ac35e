"""Takes a run's state apart into a checkpoint, and puts it together again."""

from __future__ import annotations

from typing import Any, Protocol

from actors.service.fault_policy import Component, ComponentFailed, ComponentKind
from actors.storage.uri import Location, join_location
from learner.checkpoints.checkpoint import Checkpoint, Retention
from learner.checkpoints.retention import Score, scores_of
from learner.checkpoints.writer import CheckpointResult, CheckpointWriter, RunPosition, SavingComponent
from learner.config import RunConfig, to_dict
from learner.tracking.journal import Journal
from learner.training.counters import Progress
from learner.training.recovery import Mender

LEARNER = Component(ComponentKind.LEARNER)


class SaveObserver(Protocol):
    """What is told of checkpoints."""

    def checkpoint(self, folder: Location, journal_offset: int) -> None:
        """A checkpoint is whole; rows up to the offset are covered by it."""
        ...

    def checkpoint_failed(self, env_steps: int, reason: str) -> None:
        """The checkpoint of these env steps could not be written; the run goes on."""
        ...


class Saver:
    """Begins checkpoints, one at a time, and tells how they ended.

    Args:
      config: the run.
      keep_best: the best checkpoints that are kept beside the newest.
      checkpointer: writes them.
      mender: knows the run's parts.
      progress: what the driver knows of the run.
      journal: the run's rows.
      observer: is told.
    """

    def __init__(
        self,
        config: RunConfig,
        keep_best: int,
        checkpointer: CheckpointWriter,
        mender: Mender,
        progress: Progress,
        journal: Journal,
        observer: SaveObserver,
    ) -> None:
        self._config = config
        self._keep_best = keep_best
        self._checkpointer = checkpointer
        self._mender = mender
        self._progress = progress
        self._journal = journal
        self._observer = observer
        self._scores: list[Score] = []
        self._scored_to = 0
        """Rows before this byte of the journal have been looked through for scores: hours of them are long."""
        self._saved: Location | None = None
        self._saved_at: tuple[int, int] | None = None
        self.is_wanted = False
        """Whether a checkpoint is to begin as soon as one can."""

    @property
    def saved(self) -> Location | None:
        """The checkpoint of this very moment; None if it has not been written."""
        return self._saved if self._saved_at == (self._progress.env_steps, self._progress.updates) else None

    @property
    def may_begin(self) -> bool:
        """Whether a checkpoint is wanted, and none is being written."""
        return self.is_wanted and not self._checkpointer.is_busy

    def begin(self) -> None:
        """Begins a checkpoint while nothing is under way.

        Raises:
          ComponentFailed: a part could not begin; the checkpoint stays wanted.
        """
        moment = RunPosition(self._progress.env_steps, self._progress.updates, self._journal.length)
        draft = self._checkpointer.draft(moment.env_steps)
        writers = [
            SavingComponent(part, self._mender.incarnation(part), self._mender.node(part)) for part in self._parts()
        ]
        try:
            state = self._state(draft, moment)
        except ComponentFailed as failure:
            self.is_wanted = True
            self._checkpointer.abort(
                moment, [writer for writer in writers if writer.component != failure.component], failure
            )
            raise
        self.is_wanted = False
        self._checkpointer.begin(moment, draft, state, writers, lambda: self._seal(moment))

    def _parts(self) -> list[Component]:
        return [LEARNER, *self._mender.workers]

    def _state(self, draft: Location, moment: RunPosition) -> dict[str, Any]:
        """Tells all parts to save themselves to `draft`; the rest of the run's state, for JSON."""
        places = {worker: (_worker_file(draft, worker),) for worker in self._mender.workers}
        learner, *workers = self._mender.ask_all("save", {LEARNER: (draft,)} | places)
        return self._progress.get_state() | {
            "config": to_dict(self._config),
            "incarnation": self._mender.highest,
            "journal_offset": moment.journal_offset,
            "learner": learner,
            "workers": workers,
        }

    def _seal(self, moment: RunPosition) -> Retention:
        """Makes the journal durable before a checkpoint counts on it; tells which checkpoints stay."""
        self._journal.sync()
        self._scores += scores_of(self._journal.rows(self._scored_to, moment.journal_offset))
        self._scored_to = moment.journal_offset
        return Retention(self._config.keep_checkpoints, self._keep_best, list(self._scores))

    def poll(self) -> ComponentFailed | None:
        """Tells of a checkpoint that has ended; a part that failed meanwhile is the caller's to mend."""
        return self._take(self._checkpointer.poll())

    def wait(self) -> ComponentFailed | None:
        """As `poll`, once the one that is being written has ended."""
        return self._take(self._checkpointer.wait())

    def give_up(self) -> None:
        """Ends what is being written (see `CheckpointWriter.abandon`)."""
        self._checkpointer.abandon()

    def _take(self, ended: CheckpointResult | None) -> ComponentFailed | None:
        if ended is None:
            return None
        moment = ended.position
        if ended.location is None:
            self._observer.checkpoint_failed(moment.env_steps, ended.error or "")
            self.is_wanted |= ended.failure is not None  # else the storage failed: not before the next one is due
            return ended.failure
        self._observer.checkpoint(ended.location, moment.journal_offset)
        self._saved, self._saved_at = ended.location, (moment.env_steps, moment.updates)
        return None

    def restore(self, checkpoint: Checkpoint) -> None:
        """Takes up a checkpoint of this config.

        Raises:
          ValueError: its files do not fit this run.
          ComponentFailed: a part failed.
        """
        folder, state = checkpoint
        self._mender.ask(LEARNER, "load", folder, state["learner"])
        for worker in self._mender.workers:
            self._mender.ask(worker, "load", _worker_file(folder, worker), state["workers"][worker.number])
        self._progress.set_state(state)
        self._saved, self._saved_at = folder, (self._progress.env_steps, self._progress.updates)


def _worker_file(folder: Location, worker: Component) -> Location:
    return join_location(folder, f"worker-{worker.number}.safetensors")
