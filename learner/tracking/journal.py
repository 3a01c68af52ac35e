"""The run's metrics as a local file, whose length a checkpoint knows.

MLflow is a mirror of it: rows are pushed once a checkpoint covers them, with the time they were made, so
that a row that is pushed twice is stored once, and a resumed run neither repeats nor misses a step.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import NamedTuple

from actors.storage.atomic_write import replacing_file
from sim_core.checks import ConfigError

ACCOUNT = "account/"
"""Begins the names of counts since the start of the run."""
FINAL = "final/"
"""Begins the names of a run's results."""
_FOR_MONITORING = (
    "replay/size",
    "policy/staleness_s",
    "train/td_error",
    "train/episode_length",
    "eval/episode_length",
    "time/worker_acts",
    "time/learner_updates",
    "time/learner_publishes",
    "time/learner_stores",
    "system/cpu_utilization_percentage",
)
_WITH_INTERVAL = ("final/success_rate", "final/return")
_ENDS = ("_low", "_high")


def charted(metrics: dict[str, float]) -> dict[str, float]:
    """What of a row goes to MLflow, whose charts want few keys (under 30 of a run).

    Not the accounts nor what only monitoring asks for, and of the intervals that of the result alone.
    """
    return {name: value for name, value in metrics.items() if _is_charted(name)}


def _is_charted(name: str) -> bool:
    if name.endswith(_ENDS):
        return name.startswith(_WITH_INTERVAL)
    return not name.startswith(ACCOUNT) and name not in _FOR_MONITORING


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
        """Writes one row, at once, so that whoever looks into a run sees it; `sync` makes it durable."""
        self._file.write(json.dumps(row).encode() + b"\n")
        self._file.flush()

    @property
    def length(self) -> int:
        """Bytes of all rows so far."""
        return self._file.tell()

    def sync(self) -> int:
        """Makes all rows durable; returns the file's length in bytes."""
        self._file.flush()
        os.fsync(self._file.fileno())
        return self._file.tell()

    def rows(self, start: int = 0, end: int | None = None) -> list[Row]:
        """The rows from byte `start` on, up to byte `end`; any thread may ask."""
        self._file.flush()
        with self._path.open("rb") as file:
            file.seek(start)
            lines = file.read(-1 if end is None else max(0, end - start)).splitlines()
        return [Row(*json.loads(line)) for line in lines]

    def close(self) -> None:
        """Closes the file."""
        self._file.close()


def read_rows(path: Path) -> list[Row]:
    """The whole rows of a journal that another process may be writing; none where there is no journal yet.

    Raises:
      ConfigError: the file cannot be read or holds something else.
    """
    try:
        lines = path.read_bytes().split(b"\n")[:-1]  # the last one may be unfinished
        return [Row(*json.loads(line)) for line in lines]
    except FileNotFoundError:
        return []
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

    @staticmethod
    def value(path: Path) -> int:
        """The byte that the file `path` notes; 0 where nothing is noted."""
        try:
            return int(path.read_text())
        except (OSError, ValueError):
            return 0

    def read(self) -> int:
        """The byte; 0 where nothing is noted."""
        return self.value(self._path)

    def write(self, offset: int) -> None:
        """Notes a byte."""
        with replacing_file(self._path) as partial:
            partial.write_text(str(offset))
