"""Writes checkpoints in the background: the nodes' parts in their threads, state and manifest in one of the driver's.

Training stands still only while the nodes take their snapshots. A checkpoint that fails is told of, and costs nothing
else: older ones stay, and the next one is tried as if nothing had happened.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from actors.service.fault_policy import CallFailed, Component, ComponentFailed, Fault, first_line
from actors.service.rpc import Calls, Node
from actors.storage.fragment_writer import FileSum, WriteResult, join_results
from actors.storage.uri import Location
from learner.checkpoints.checkpoint import Retention, commit_checkpoint, prune_checkpoints
from learner.checkpoints.store import open_store

DEADLINE_S = 900.0
"""A part that is not written by then counts as failed."""
POLL_S = 0.05
"""Time between two questions to the nodes whether they have written."""


class RunPosition(NamedTuple):
    """What a checkpoint is of: env steps and updates so far, and bytes of the journal that it covers."""

    env_steps: int
    updates: int
    journal_offset: int


class CheckpointResult(NamedTuple):
    """How a checkpoint ended: its position, and its location or else why it could not be written.

    `failure` tells of the part of the run that failed meanwhile, if that is why.
    """

    position: RunPosition
    location: Location | None
    error: str | None
    failure: ComponentFailed | None = None


class SavingComponent(NamedTuple):
    """A part of the run that has been told to save itself: which, of which incarnation, and its node with `saved`."""

    component: Component
    incarnation: int
    node: Node

    def failed(self, failure: CallFailed) -> ComponentFailed:
        """The failure as one of the part."""
        return ComponentFailed(self.component, self.incarnation, failure.fault, f"saved: {failure.reason}")


class Abandoned(Exception):
    """Nobody waits for the checkpoint any more."""


class CheckpointWriter:
    """Writes one checkpoint of a run at a time.

    Args:
      root: where they lie.
      calls: how to call the nodes, from another thread too.
      patience_s: a part that does not answer for so long is late.
    """

    def __init__(self, root: Location, calls: Calls, patience_s: float) -> None:
        self._store = open_store(root)
        self._calls = calls
        self._patience_s = patience_s
        self._thread: threading.Thread | None = None
        self._ended: CheckpointResult | None = None
        self._abandoned = threading.Event()

    @property
    def is_busy(self) -> bool:
        """Whether a checkpoint is being written, or its end has not been asked for."""
        return self._thread is not None

    def draft(self, env_steps: int) -> Location:
        """Where the nodes are to write their parts of the next checkpoint."""
        return self._store.draft(env_steps)

    def begin(
        self,
        position: RunPosition,
        draft: Location,
        state: dict[str, Any],
        writers: list[SavingComponent],
        seal: Callable[[], Retention],
    ) -> None:
        """Goes on in the background, once every part has begun to save.

        Args:
          position: what the checkpoint is of.
          draft: where the parts write.
          state: the rest of the state, for JSON; nobody changes it any more.
          writers: the parts.
          seal: is called before the checkpoint is completed, in another thread; tells which ones stay afterwards.
        """

        def write() -> None:
            files = self._parts(writers)
            keep = seal()
            location = commit_checkpoint(self._store, draft, position.env_steps, state, files)
            self._ended = CheckpointResult(position, location, None)
            prune_checkpoints(self._store, location, keep)

        self._start(position, write)

    def abort(self, position: RunPosition, writers: list[SavingComponent], failure: ComponentFailed) -> None:
        """Waits in the background until `writers` are ready for another checkpoint: this one could not begin.

        Args:
          position: what the checkpoint would have been of.
          writers: the parts that may have begun to save.
          failure: of a part that did not, which the caller mends.
        """

        def write() -> None:
            self._parts(writers)
            raise OSError(str(failure))

        self._start(position, write)

    def _start(self, position: RunPosition, write: Callable[[], None]) -> None:
        assert self._thread is None
        self._ended = None
        self._thread = threading.Thread(
            target=self._guard, args=(position, write), name="shoal-checkpoint", daemon=True
        )
        self._thread.start()

    def _guard(self, position: RunPosition, write: Callable[[], None]) -> None:
        try:
            write()
        except Exception as error:  # a disk's, a storage client's, Ray's: each raises its own, and training goes on
            # a new one: references in the traceback must not outlive Ray
            failure = ComponentFailed(*error.args) if isinstance(error, ComponentFailed) else None
            self._ended = self._ended or CheckpointResult(position, None, first_line(error), failure)
            self._tidy()

    def _tidy(self) -> None:
        try:
            self._store.remove([])  # the draft
        except OSError:
            pass  # whatever kept the checkpoint from being written; the next one tidies up

    def _parts(self, writers: list[SavingComponent]) -> dict[str, FileSum]:
        """Waits until all parts have written, even if one has failed: the next checkpoint must find them ready."""
        deadline_s = time.monotonic() + DEADLINE_S
        waiting, written, failures = list(writers), [], []
        while waiting:
            for writer in list(waiting):
                try:
                    answer = self._ask(writer)
                except ComponentFailed as failure:
                    failures.append(failure)
                    waiting.remove(writer)
                    continue
                if answer is not None:
                    written.append(answer)
                    waiting.remove(writer)
            if waiting and time.monotonic() > deadline_s:
                late = ", ".join(sorted(str(writer.component) for writer in waiting))
                raise TimeoutError(f"{late} did not write within {DEADLINE_S:.0f} s")
            if waiting and self._abandoned.wait(POLL_S):
                raise Abandoned
        if failures:
            raise failures[0]
        return _files(written)

    def _ask(self, writer: SavingComponent) -> WriteResult | None:
        """How a part's write ended; None while it is being written.

        Raises:
          ComponentFailed: it does not answer.
          Abandoned: the run does not go on like this.
        """
        late_s = time.monotonic() + self._patience_s
        try:
            ref = self._calls.start(writer.node, "saved")
            while not self._calls.wait([ref], POLL_S):
                if self._abandoned.is_set():
                    raise Abandoned
                if time.monotonic() > late_s:
                    raise CallFailed(Fault.LATE, f"silent for {self._patience_s:.0f} s")
            answer: WriteResult | None = self._calls.get(ref)
        except CallFailed as failure:
            raise writer.failed(failure) from failure
        return answer

    def poll(self) -> CheckpointResult | None:
        """How the checkpoint under way ended, told once; None while it is being written, or there is none."""
        return None if self._thread is None or self._thread.is_alive() else self.wait()

    def wait(self) -> CheckpointResult | None:
        """Waits for the checkpoint under way and tells how it ended; None if there is none."""
        if self._thread is None:
            return None
        self._thread.join()
        self._thread = None
        return self._ended

    def abandon(self) -> None:
        """Waits for no part any more: the run ends, or goes on with others. What writes does not outlive this call."""
        self._abandoned.set()
        self.wait()


def _files(written: list[WriteResult]) -> dict[str, FileSum]:
    """The files of all parts.

    Raises:
      OSError: one could not be written.
    """
    joined = join_results([*written])
    assert joined is not None
    if joined.error is not None:
        raise OSError(joined.error)
    return joined.files
