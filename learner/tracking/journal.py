"""The journal: a run's metrics in a local file, the source that MLflow mirrors.

A checkpoint holds the journal's length. Rows are pushed to MLflow once a checkpoint covers them, each with the time at
which it was measured. So a row that is pushed twice is stored once, and a resumed run neither repeats nor misses a row.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from actors.storage.append_file import AppendFile
from actors.storage.atomic_write import replacing_file
from actors.storage.permissions import may_not_read
from sim_core.checks import ConfigError

ACCOUNT = "account/"
"""Prefix of metrics that count since the start of the run."""
FINAL = "final/"
"""Prefix of the metrics of a run's result."""
_MONITORING_ONLY = (
    "replay/size",
    "policy/staleness_s",
    "train/td_error",
    "train/episode_length",
    "eval/episode_length",
    "eval/last_arrival_steps",
    "eval/learner_collision_rate",
    "eval/q_start",
    "eval/return_start",
    "time/worker_acts",
    "time/worker_stores",
    "time/learner_updates",
    "time/learner_samples",
    "time/learner_publishes",
    "time/learner_stores",
    "system/cpu_utilization_percentage",
)
_WITH_INTERVAL = ("final/success_rate", "final/return")
_INTERVAL_ENDS = ("_low", "_high")


def mlflow_metrics(metrics: dict[str, float]) -> dict[str, float]:
    """The metrics of a row that MLflow gets: fewer than 30 names a run, since its UI draws a chart for each.

    Left out are the accounts, what only monitoring needs, and all confidence intervals but those of the result.
    """
    return {name: value for name, value in metrics.items() if _is_for_mlflow(name)}


def _is_for_mlflow(name: str) -> bool:
    if name.endswith(_INTERVAL_ENDS):
        return name.startswith(_WITH_INTERVAL)
    return not name.startswith(ACCOUNT) and name not in _MONITORING_ONLY


class Row(NamedTuple):
    """Metrics measured at one time: env steps, wall time in ms since the epoch, values by name."""

    env_steps: int
    time_ms: int
    metrics: dict[str, float]


class Journal:
    """An append-only file of rows, one JSON line each; while the disk is full, rows are held in memory.

    Args:
      path: the file; made if missing.
      offset: length in bytes that the checkpoint covers; the file is truncated to it.
      say: shows a line to the user.

    Raises:
      ConfigError: the file is shorter than `offset`.
    """

    def __init__(self, path: Path, offset: int, say: Callable[[str], None] = lambda text: None) -> None:
        self._file = AppendFile(path, say)
        length = self._file.length
        if length < offset:
            self._file.close()
            raise ConfigError(
                f"{path} has {length} bytes, its checkpoint needs {offset}: restore the whole file or start a new run"
            )
        self._file.truncate(offset)

    def append(self, row: Row) -> None:
        """Writes a row, visible to other processes at once; `sync` makes it durable."""
        self._file.append(json.dumps(row).encode() + b"\n")

    @property
    def length(self) -> int:
        """Length in bytes, with rows that a full disk has not taken yet."""
        return self._file.length

    def sync(self) -> int:
        """Makes all rows durable; returns the file's length in bytes.

        Raises:
          OSError: the disk does not take all of them.
        """
        return self._file.sync()

    def rows(self, start: int = 0, end: int | None = None) -> list[Row]:
        """The rows from byte `start` up to byte `end`, or the end of the file; callable from any thread."""
        return [Row(*json.loads(line)) for line in self._file.read(start, end).splitlines()]

    def close(self) -> None:
        """Closes the file."""
        self._file.close()


def read_rows(path: Path) -> list[Row]:
    """The rows of a journal that another process may be writing, but a half-written last one; none without a file.

    Raises:
      ConfigError: the file cannot be read or is not a journal.
    """
    try:
        lines = path.read_bytes().split(b"\n")[:-1]  # the last one may be half written
        return [Row(*json.loads(line)) for line in lines]
    except FileNotFoundError:
        return []
    except PermissionError as error:
        raise ConfigError(may_not_read(path)) from error
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise ConfigError(f"the metrics {path} cannot be read ({error}); restore the whole file") from error


class PushedMark:
    """A file that remembers how many bytes of the journal MLflow has; after a crash, rows are at worst pushed again.

    Args:
      path: the file.
      limit: the journal's length; a larger mark is lowered to it.
    """

    def __init__(self, path: Path, limit: int) -> None:
        self._path = path
        if self.read() > limit:
            self.write(limit)

    @staticmethod
    def value(path: Path) -> int:
        """The mark in the file `path`, in bytes; 0 if there is none."""
        try:
            return int(path.read_text())
        except (OSError, ValueError):
            return 0

    def read(self) -> int:
        """The mark in bytes; 0 if there is none."""
        return self.value(self._path)

    def write(self, offset: int) -> None:
        """Sets the mark."""
        with replacing_file(self._path) as partial:
            partial.write_text(str(offset))
