"""One node's part of a checkpoint, written in a thread while the node works on."""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from actors.storage.malloc import give_back
from actors.storage.uri import Location, files_under, staged


class FileSum(NamedTuple):
    """What a file must be: its length in bytes, and the SHA-256 of its content in hex."""

    size: int
    sha256: str


class WriteResult(NamedTuple):
    """How writing a part ended: its files, by name relative to the checkpoint's folder; else why it failed."""

    files: dict[str, FileSum]
    error: str | None


def join_results(parts: list[WriteResult | None]) -> WriteResult | None:
    """How several parts ended: None while one is being written, else all their files and the first failure."""
    ended = [part for part in parts if part is not None]
    if len(ended) < len(parts):
        return None
    errors = [part.error for part in ended if part.error is not None]
    files = {name: found for part in ended for name, found in part.files.items()}
    return WriteResult(files, errors[0] if errors else None)


class FragmentWriter:
    """Writes parts in a thread, one at a time."""

    def __init__(self) -> None:
        self._thread: threading.Thread | None = None
        self._is_blocked = False
        self._written = WriteResult({}, "nothing was being written: the process is a new one")

    def start(self, location: Location, write: Callable[[Path], None]) -> bool:
        """Starts writing the file or folder at `location`.

        Args:
          location: where it will be.
          write: writes it to the path that it is given, from data that nobody changes meanwhile.

        Returns:
          Whether `write` will be called: where an earlier part is still being written, this one fails at once.
        """
        self._is_blocked = self._thread is not None and self._thread.is_alive()
        if self._is_blocked:
            return False
        self._thread = threading.Thread(target=self._write, args=(location, write), name="shoal-part", daemon=True)
        self._thread.start()
        return True

    def _write(self, location: Location, write: Callable[[Path], None]) -> None:
        try:
            with staged(location) as local:
                write(local)
                files = {name: file_sum(path) for name, path in files_under(local).items()}
                if local is location:
                    sync_all(local)
            self._written = WriteResult(files, None)
        except Exception as error:  # whatever a disk, a storage's client or a format raises: the run goes on
            self._written = WriteResult({}, f"{type(error).__name__}: {error}")
        threading.Thread(target=give_back, name="shoal-memory", daemon=True).start()  # nobody waits for it

    def result(self, timeout_s: float = 0.0) -> WriteResult | None:
        """How the last part ended; None while it is still being written after `timeout_s`."""
        if self._is_blocked:
            return WriteResult({}, "the part of an earlier checkpoint is still being written")
        if self._thread is not None:
            self._thread.join(timeout_s)
            if self._thread.is_alive():
                return None
        return self._written


def file_sum(path: Path) -> FileSum:
    """Length and SHA-256 of a file."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        return FileSum(file.tell(), digest)


def sync_all(path: Path) -> None:
    """Makes a file, or a folder with all in it, durable; the folder around it is the caller's to sync."""
    for each in [path, *path.rglob("*")] if path.is_dir() else [path]:
        sync(each)


def sync(path: Path) -> None:
    """Makes a file's content, or a folder's list of names, durable."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
