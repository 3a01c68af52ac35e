"""What trainings expect of their policies, beside what these get: a table with a row per evaluation."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from actors.storage.csv_table import read_csv, write_csv


class ValueRow(NamedTuple):
    """One evaluation during a training.

    Fields: preset; method, robots per group, groups, algorithm and seed of the training; env steps until then, of how
    many; greedy episodes, and the means over them of the fields of `actors.service.messages.VALUE_DTYPE`.
    """

    preset: str
    method: str
    robots: int
    groups: int
    algorithm: str
    seed: int
    env_steps: int
    total_env_steps: int
    episodes: int
    q_start: float
    return_start: float
    q_visited: float
    return_visited: float


def write_values(path: Path, rows: Iterable[ValueRow]) -> None:
    """Writes rows in a fixed order to a CSV file; an older file is replaced once the new one is complete."""
    write_csv(path, ValueRow, rows)


def read_values(path: Path) -> list[ValueRow]:
    """Reads what `write_values` wrote.

    Raises:
      ConfigError: the file cannot be read or is no such table.
    """
    return read_csv(path, ValueRow, "values", "`make overestimation` makes one")
