"""Writes checkpoints in the background: the nodes' parts in their threads, state and manifest in one of the driver's.

Training stands still only while the nodes take their snapshots. A checkpoint that fails is told of, and costs nothing
else: older ones stay, and the next one is tried as if nothing had happened.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from actors.calls import Calls, Node
from actors.locations import Location
from actors.parts import FileSum, Written, join_written
from learner.checkpoint import Keep, complete_checkpoint, keep_checkpoints
from learner.checkpoint_store import open_store

DEADLINE_S = 900.0
"""A part that is not written by then counts as failed."""
POLL_S = 0.05
"""Time between two questions to the nodes whether they have written."""


class Moment(NamedTuple):
    """What a checkpoint is of: env steps and updates so far, and bytes of the journal that it covers."""

    env_steps: int
    updates: int
    journal_offset: int


class Ended(NamedTuple):
    """How a checkpoint ended: its moment, and its location or else why it could not be written."""

    moment: Moment
    location: Location | None
    error: str | None


class Checkpointer:
    """Writes one checkpoint of a run at a time.

    Args:
      root: where they lie.
      calls: how to call the nodes, from another thread too.
    """

    def __init__(self, root: Location, calls: Calls) -> None:
        self._store = open_store(root)
        self._calls = calls
        self._thread: threading.Thread | None = None
        self._ended: Ended | None = None

    @property
    def is_busy(self) -> bool:
        """Whether a checkpoint is being written, or its end has not been asked for."""
        return self._thread is not None

    def draft(self, env_steps: int) -> Location:
        """Where the nodes are to write their parts of the next checkpoint."""
        return self._store.draft(env_steps)

    def begin(
        self, moment: Moment, draft: Location, state: dict[str, Any], nodes: dict[str, Node], seal: Callable[[], Keep]
    ) -> None:
        """Goes on in the background, once every node has begun to save.

        Args:
          moment: what the checkpoint is of.
          draft: where the nodes write.
          state: the rest of the state, for JSON; nobody changes it any more.
          nodes: the nodes by name, with `saved`.
          seal: is called before the checkpoint is completed, in another thread; tells which ones stay afterwards.
        """
        assert self._thread is None
        self._ended = None
        self._thread = threading.Thread(
            target=self._write, args=(moment, draft, state, nodes, seal), name="shoal-checkpoint", daemon=True
        )
        self._thread.start()

    def _write(
        self, moment: Moment, draft: Location, state: dict[str, Any], nodes: dict[str, Node], seal: Callable[[], Keep]
    ) -> None:
        try:
            files = self._parts(nodes)
            keep = seal()
            location = complete_checkpoint(self._store, draft, moment.env_steps, state, files)
            self._ended = Ended(moment, location, None)
            keep_checkpoints(self._store, location, keep)
        except Exception as error:  # a disk's, a storage client's, Ray's: each raises its own, and training goes on
            reason = (str(error).splitlines() or [""])[0] or type(error).__name__
            self._ended = self._ended or Ended(moment, None, reason)
            self._tidy()

    def _tidy(self) -> None:
        try:
            self._store.remove([])  # the draft
        except OSError:
            pass  # whatever kept the checkpoint from being written; the next one tidies up

    def _parts(self, nodes: dict[str, Node]) -> dict[str, FileSum]:
        """Waits until all nodes have written, even if one has failed: the next checkpoint must find them ready."""
        deadline_s = time.monotonic() + DEADLINE_S
        ended: dict[str, Written] = {}
        while len(ended) < len(nodes):
            for name in nodes.keys() - ended.keys():
                written = self._calls.get(self._calls.start(nodes[name], "saved"))
                if written is not None:
                    ended[name] = written
            if len(ended) < len(nodes):
                late = ", ".join(sorted(nodes.keys() - ended.keys()))
                if time.monotonic() > deadline_s:
                    raise TimeoutError(f"{late} did not write within {DEADLINE_S:.0f} s")
                time.sleep(POLL_S)
        joined = join_written(list(ended.values()))
        assert joined is not None
        if joined.error is not None:
            raise OSError(joined.error)
        return joined.files

    def poll(self) -> Ended | None:
        """How the checkpoint under way ended, told once; None while it is being written, or there is none."""
        return None if self._thread is None or self._thread.is_alive() else self.wait()

    def wait(self) -> Ended | None:
        """Waits for the checkpoint under way and tells how it ended; None if there is none."""
        if self._thread is None:
            return None
        self._thread.join()
        self._thread = None
        return self._ended
