"""Writes checkpoints in the background while training goes on.

Each component writes its fragment in a thread of its own process. A thread of the driver waits for all of them and
commits the checkpoint. Training pauses only while the components copy their state. A checkpoint that fails is reported;
older ones stay, and the next one is tried when it is due.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from actors.service.fault_policy import CallFailed, ComponentFailed, Fault, first_line
from actors.service.rpc import Calls, Placed
from actors.storage.fragment_writer import FileSum, WriteResult, join_results
from actors.storage.uri import Location
from learner.checkpoints.checkpoint import Retention, commit_checkpoint, prune_checkpoints
from learner.checkpoints.store import open_store

DEADLINE_S = 900.0
"""Time after which a checkpoint fails whose fragments are not all written."""
POLL_S = 0.05
"""Time between two questions to a component whether it has written its fragment."""


class RunPosition(NamedTuple):
    """How far a run is: env steps and updates so far, and bytes of its journal."""

    env_steps: int
    updates: int
    journal_offset: int


class CheckpointResult(NamedTuple):
    """How writing a checkpoint ended: the run's position in it, and its location or the error.

    `failure` is the failed component, where that is the reason.
    """

    position: RunPosition
    location: Location | None
    error: str | None
    failure: ComponentFailed | None = None


class Checkpointable(Protocol):
    """A node that saves itself as fragments of a checkpoint: the learner, or a rollout worker."""

    def save(self, location: Location) -> dict[str, Any]:
        """Starts to write its fragments to `location`; returns the rest of its state, for JSON."""
        ...

    def saved(self, timeout_s: float = 0.0) -> WriteResult | None:
        """How the last `save` ended; None while it is still being written after `timeout_s`."""
        ...


class Abandoned(Exception):
    """Nobody waits for the checkpoint any more."""


class CheckpointWriter:
    """Writes one checkpoint of a run at a time.

    Args:
      root: location of the run's checkpoints.
      calls: calls the nodes; used from another thread, too.
      answer_deadline_s: a component that does not answer for this long counts as late.
    """

    def __init__(self, root: Location, calls: Calls, answer_deadline_s: float) -> None:
        self._store = open_store(root)
        self._calls = calls
        self._answer_deadline_s = answer_deadline_s
        self._thread: threading.Thread | None = None
        self._result: CheckpointResult | None = None
        self._abandoned = threading.Event()

    @property
    def is_busy(self) -> bool:
        """Whether a checkpoint is being written, or its result has not been taken (see `poll`)."""
        return self._thread is not None

    def draft(self, env_steps: int) -> Location:
        """Where the components write their fragments of the next checkpoint."""
        return self._store.draft(env_steps)

    def begin(
        self,
        position: RunPosition,
        draft: Location,
        state: dict[str, Any],
        components: list[Placed[Checkpointable]],
        before_commit: Callable[[], Retention],
    ) -> None:
        """Waits for the fragments and commits the checkpoint, in the background.

        Args:
          position: the run's position in the checkpoint.
          draft: where the fragments are written.
          state: the driver's state, JSON values; nobody may change it any more.
          components: those that have begun to save themselves.
          before_commit: called in another thread before the commit; says which checkpoints to keep after it.
        """

        def write() -> None:
            files = self._wait_for_fragments(components)
            retention = before_commit()
            location = commit_checkpoint(self._store, draft, position.env_steps, state, files)
            self._result = CheckpointResult(position, location, None)
            prune_checkpoints(self._store, location, retention)

        self._start(position, write)

    def abort(self, position: RunPosition, components: list[Placed[Checkpointable]], failure: ComponentFailed) -> None:
        """Fails a checkpoint that could not begin, once `components` can save themselves again; in the background.

        Args:
          position: the run's position in it.
          components: those that may have begun to save themselves.
          failure: of a component that did not; the caller handles it.
        """

        def write() -> None:
            self._wait_for_fragments(components)
            raise OSError(str(failure))

        self._start(position, write)

    def _start(self, position: RunPosition, write: Callable[[], None]) -> None:
        assert self._thread is None
        self._result = None
        self._thread = threading.Thread(target=self._run, args=(position, write), name="shoal-checkpoint", daemon=True)
        self._thread.start()

    def _run(self, position: RunPosition, write: Callable[[], None]) -> None:
        try:
            write()
        except Exception as error:  # disks, storage clients and Ray raise their own types, and training must go on
            # A new exception: references in the traceback of `error` must not outlive Ray.
            failure = ComponentFailed(*error.args) if isinstance(error, ComponentFailed) else None
            self._result = self._result or CheckpointResult(position, None, first_line(error), failure)
            self._remove_drafts()

    def _remove_drafts(self) -> None:
        try:
            self._store.remove([])
        except OSError:
            pass  # the storage is still unreachable; the next checkpoint removes them

    def _wait_for_fragments(self, components: list[Placed[Checkpointable]]) -> dict[str, FileSum]:
        """Waits until all fragments are written, even if one has failed: then all components can save again.

        Returns:
          Length and checksum of the fragments' files, by name.

        Raises:
          ComponentFailed: a component failed.
          OSError: a fragment could not be written, or not in time.
          Abandoned: see `abandon`.
        """
        deadline_s = time.monotonic() + DEADLINE_S
        waiting, written, failures = list(components), [], []
        while waiting:
            for component in list(waiting):
                try:
                    answer = self._ask(component)
                except ComponentFailed as failure:
                    failures.append(failure)
                    waiting.remove(component)
                    continue
                if answer is not None:
                    written.append(answer)
                    waiting.remove(component)
            if waiting and time.monotonic() > deadline_s:
                late = ", ".join(sorted(str(each.component) for each in waiting))
                raise TimeoutError(f"{late} did not write within {DEADLINE_S:.0f} s")
            if waiting and self._abandoned.wait(POLL_S):
                raise Abandoned
        if failures:
            raise failures[0]
        return _files(written)

    def _ask(self, component: Placed[Checkpointable]) -> WriteResult | None:
        """How the component's write ended; None while it is writing.

        Raises:
          ComponentFailed: it does not answer.
          Abandoned: see `abandon`.
        """
        deadline_s = time.monotonic() + self._answer_deadline_s
        try:
            ref = self._calls.start(component.node, Checkpointable.saved)
            while not self._calls.wait([ref], POLL_S):
                if self._abandoned.is_set():
                    raise Abandoned
                if time.monotonic() > deadline_s:
                    raise CallFailed(Fault.LATE, f"silent for {self._answer_deadline_s:.0f} s")
            return self._calls.get(ref)
        except CallFailed as failure:
            raise failure.of(component.component, component.incarnation, "saved") from failure

    def poll(self) -> CheckpointResult | None:
        """Takes the result of the checkpoint being written; None while it is being written, or if there is none."""
        return None if self._thread is None or self._thread.is_alive() else self.wait()

    def wait(self) -> CheckpointResult | None:
        """Waits for the checkpoint being written and takes its result; None if there is none."""
        if self._thread is None:
            return None
        self._thread.join()
        self._thread = None
        return self._result

    def abandon(self) -> None:
        """Stops waiting for fragments: the run ends, or goes on with other components. Returns once nothing writes."""
        self._abandoned.set()
        self.wait()


def _files(written: list[WriteResult]) -> dict[str, FileSum]:
    """The files of all fragments.

    Raises:
      OSError: one could not be written.
    """
    joined = join_results([*written])
    assert joined is not None
    if joined.error is not None:
        raise OSError(joined.error)
    return joined.files
