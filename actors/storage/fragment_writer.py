"""Writes one component's fragment of a checkpoint in a thread, while the component keeps working."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from actors.storage.atomic_write import sync_all
from actors.storage.malloc import trim_heap
from actors.storage.uri import Location, files_under, staged


class FileSum(NamedTuple):
    """Size of a file in bytes, and the SHA-256 of its content in hex; the checkpoint's manifest lists them."""

    size: int
    sha256: str


class WriteResult(NamedTuple):
    """Outcome of writing a fragment: its files, named relative to the checkpoint's folder, or the error."""

    files: dict[str, FileSum]
    error: str | None


def join_results(results: list[WriteResult | None]) -> WriteResult | None:
    """Joins the results of several fragments: all files and the first error; None while one is being written."""
    done = [result for result in results if result is not None]
    if len(done) < len(results):
        return None
    errors = [result.error for result in done if result.error is not None]
    files = {name: found for result in done for name, found in result.files.items()}
    return WriteResult(files, errors[0] if errors else None)


class FragmentWriter:
    """Writes fragments in a thread, one at a time."""

    def __init__(self) -> None:
        self._thread: threading.Thread | None = None
        self._is_blocked = False
        self._result = WriteResult({}, "nothing was being written: the process has restarted")

    def start(self, location: Location, write: Callable[[Path], object]) -> bool:
        """Starts to write a file or folder.

        Args:
          location: where the file or folder will be.
          write: writes it to the path it is given, from data that nobody changes in the meantime.

        Returns:
          Whether `write` will be called. While an earlier fragment is still being written, the new one fails at once.
        """
        self._is_blocked = self._thread is not None and self._thread.is_alive()
        if self._is_blocked:
            return False
        self._thread = threading.Thread(target=self._write, args=(location, write), name="shoal-fragment", daemon=True)
        self._thread.start()
        return True

    def _write(self, location: Location, write: Callable[[Path], object]) -> None:
        try:
            with staged(location) as local:
                write(local)
                files = {name: file_sum(path) for name, path in files_under(local).items()}
                if local is location:
                    sync_all(local)
            self._result = WriteResult(files, None)
        except Exception as error:  # any error of a disk, a storage client or a format: the run continues
            self._result = WriteResult({}, f"{type(error).__name__}: {error}")
        threading.Thread(target=trim_heap, name="shoal-memory", daemon=True).start()  # nothing waits for this

    def result(self, timeout_s: float = 0.0) -> WriteResult | None:
        """Result of the last fragment; None if it is still being written after `timeout_s`."""
        if self._is_blocked:
            return WriteResult({}, "the fragment of an earlier checkpoint is still being written")
        if self._thread is not None:
            self._thread.join(timeout_s)
            if self._thread.is_alive():
                return None
        return self._result


def file_sum(path: Path) -> FileSum:
    """Size and SHA-256 of a file."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        return FileSum(file.tell(), digest)
