"""A process that dies at a place of the test's choice, played in this process: from there on, nothing it does counts.

A place is a moment just before something changes outside of the process: a file under the test's folder that is opened
for writing, renamed or removed (Python's own audit events), or a commit to MLflow's database.
"""

import os
import re
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from mlflow.tracking.fluent import _active_run_stack
from sqlalchemy import event
from sqlalchemy.orm import Session

CHANGES = {"os.rename", "os.remove"}
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT
UNSEEN = re.compile(r"\.(part|zarr)/")
"""Paths inside a draft, which nobody sees before it is whole, and the many files of a zarr store."""
RANDOM = re.compile(r"[0-9a-f]{32}|uploading\.\w+")


class Killed(BaseException):
    """What a dead process raises wherever it would change something."""


class Places:
    """Names the places that a process passes under `root`, and kills it at the first that has killed nobody yet.

    A commit is named by the file before it.
    """

    def __init__(self, root: Path) -> None:
        self._root = str(root)
        self._is_dead = False
        self._last_file = ""
        self._passed = Counter[str]()
        self.deadly: list[str] = []

    @contextmanager
    def of_a_process(self) -> Iterator[None]:
        """What runs in the `with` block is a process.

        Raises:
          Killed: it has died.
        """
        global _present
        self._is_dead, self._last_file, self._passed, _present = False, "the start", Counter(), self
        excepthook, threading.excepthook = threading.excepthook, _ignore_killed
        try:
            yield
        finally:
            _present = None
            threading.excepthook = excepthook
            _active_run_stack.get().clear()  # the next process has none of this one's

    def change(self, kind: str, path: str) -> None:
        """A change of a file."""
        if path.startswith(self._root) and not UNSEEN.search(path):
            self._last_file = f"{kind} {RANDOM.sub('*', path.removeprefix(self._root))}"
            self._pass(self._last_file)

    def commit(self) -> None:
        """A commit to the database."""
        self._pass(f"commit after {self._last_file}")

    def _pass(self, place: str) -> None:
        self._passed[place] += 1
        place = f"{place}, time {self._passed[place]}"
        if not self._is_dead and place not in self.deadly:
            self.deadly.append(place)
            self._is_dead = True
        if self._is_dead:
            raise Killed(place)


def _ignore_killed(args: threading.ExceptHookArgs) -> None:
    if not isinstance(args.exc_value, Killed):
        threading.__excepthook__(args)


_present: Places | None = None
_sees_writes: Callable[[str], None] | None = None


@contextmanager
def writes_seen(seen: Callable[[str], None]) -> Iterator[None]:
    """Calls `seen` with the path of every file that is opened for writing in the `with` block; it may raise."""
    global _sees_writes
    _sees_writes = seen
    try:
        yield
    finally:
        _sees_writes = None


def _audit(name: str, args: tuple) -> None:
    is_write = name == "open" and args[2] & WRITES
    if is_write or name in CHANGES:
        path = os.fsdecode(args[0]) if isinstance(args[0], str | bytes | os.PathLike) else ""
        if _present is not None:
            _present.change(name, path)
        if _sees_writes is not None and is_write:
            _sees_writes(path)


def _commit(session: Session) -> None:
    if _present is not None:
        _present.commit()


sys.addaudithook(_audit)
event.listen(Session, "before_commit", _commit)
