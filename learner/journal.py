"""The run's metrics as a local file, whose length a checkpoint knows.

MLflow is a mirror of it: rows are pushed once a checkpoint covers them, with the time they were made, so
that a row that is pushed twice is stored once, and a resumed run neither repeats nor misses a step.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import NamedTuple

from sim_core.checks import ConfigError


class Row(NamedTuple):
    """Metrics of one moment: env steps, wall time in milliseconds, values by name."""

    env_steps: int
    time_ms: int
    metrics: dict[str, float]


class Journal:
    """Append-only rows in a file of JSON lines.

    Args:
      path: the file.
      offset: bytes that count; what a crashed run wrote after them is cut off.

    Raises:
      ConfigError: the file is shorter than `offset`.
    """

    def __init__(self, path: Path, offset: int) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path = path
        self._file = path.open("ab")
        length = self._file.seek(0, os.SEEK_END)
        if length < offset:
            self._file.close()
            raise ConfigError(
                f"{path} has {length} bytes, its checkpoint knows {offset}: put the whole file back or train anew"
            )
        self._file.truncate(offset)
        self._file.seek(offset)

    def append(self, row: Row) -> None:
        """Writes one row."""
        self._file.write(json.dumps(row).encode() + b"\n")

    def flush(self) -> int:
        """Hands all rows to the system; returns the file's length in bytes."""
        self._file.flush()
        return self._file.tell()

    def sync(self) -> int:
        """Makes all rows durable; returns the file's length in bytes."""
        self._file.flush()
        os.fsync(self._file.fileno())
        return self._file.tell()

    def rows(self, start: int = 0, stop: int | None = None) -> list[Row]:
        """The rows from byte `start` on, to byte `stop` or the end."""
        self._file.flush()
        with self._path.open("rb") as file:
            file.seek(start)
            lines = file.read(-1 if stop is None else max(0, stop - start)).splitlines()
            return [Row(*json.loads(line)) for line in lines]

    def close(self) -> None:
        """Closes the file."""
        self._file.close()


def journal_rows(path: Path) -> list[Row]:
    """The rows of a run's journal that no process need have open; a last line that a crash cut off is left out.

    Raises:
      ConfigError: the file cannot be read or holds something else.
    """
    try:
        lines = path.read_bytes().split(b"\n")[:-1]
        return [Row(*json.loads(line)) for line in lines]
    except (OSError, ValueError, TypeError) as error:
        raise ConfigError(f"the metrics {path} cannot be read ({error}); put the whole file back") from error


class PushedMark:
    """Remembers over restarts up to which byte the journal was pushed; a crash before the note only pushes twice.

    Args:
      path: the file that holds the number.
      limit: length of the journal now; a mark beyond it does not count.
    """

    def __init__(self, path: Path, limit: int) -> None:
        self._path = path
        self.write(min(limit, self.read()))

    def read(self) -> int:
        """The byte; 0 where nothing is noted."""
        try:
            return int(self._path.read_text())
        except (OSError, ValueError):
            return 0

    def write(self, offset: int) -> None:
        """Notes a byte."""
        part = self._path.with_suffix(".part")
        part.write_text(str(offset))
        part.replace(self._path)
