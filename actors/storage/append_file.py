"""A file that only grows, and that no full disk can stop: what does not fit is held in memory and written later."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path

from actors.storage.full_disk import is_disk_full


class AppendFile:
    """Appends to a file; callable from any thread.

    Args:
      path: the file; made with its folder if missing.
      say: shows a line to the user.
    """

    def __init__(self, path: Path, say: Callable[[str], None]) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path = path
        self._say = say
        self._file = open(path, "ab", buffering=0)
        self._held = b""
        self._is_full = False
        self._lock = threading.RLock()

    @property
    def length(self) -> int:
        """Length in bytes, with what is held."""
        with self._lock:
            return self._written() + len(self._held)

    def _written(self) -> int:
        return os.fstat(self._file.fileno()).st_size

    def truncate(self, length: int) -> None:
        """Shortens the file; nothing may be held."""
        self._file.truncate(length)

    def append(self, data: bytes) -> None:
        """Writes the data, visible to other processes at once; while the disk is full, holds it."""
        with self._lock:
            self._held += data
            self._try_to_write()

    def _try_to_write(self) -> None:
        try:
            self._write_held()
        except OSError as error:
            if not is_disk_full(error):
                raise
            if not self._is_full:
                self._say(f"{self._path} cannot grow, the disk is full; its lines are kept in memory and written later")
            self._is_full = True
            return
        if self._is_full:
            self._say(f"{self._path} grows again; no line is missing")
        self._is_full = False

    def _write_held(self) -> None:
        while self._held:
            self._held = self._held[self._file.write(self._held) :]

    def read(self, start: int, end: int | None = None) -> bytes:
        """The bytes from `start` up to `end`, or the end; also those that are held."""
        with self._lock:
            written = self._written()
            stop = written + len(self._held) if end is None else end
            with self._path.open("rb") as file:
                file.seek(start)
                data = file.read(max(0, min(stop, written) - start))
            return data + self._held[max(0, start - written) : max(0, stop - written)]

    def sync(self) -> int:
        """Makes everything durable; returns the length in bytes.

        Raises:
          OSError: the disk does not take all of it.
        """
        with self._lock:
            self._write_held()
            os.fsync(self._file.fileno())
            return self._written()

    def close(self) -> None:
        """Closes the file; what a full disk does not take now is lost."""
        with self._lock:
            if not self._file.closed:
                self._try_to_write()
                self._file.close()
