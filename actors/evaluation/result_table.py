"""The results of a sweep as a table: one row per policy and setup in which it was evaluated.

Reports are made from this table, and it is committed: a CSV file that anyone can read, with counts in place of rates,
and a few dozen bytes per row.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from actors.storage.csv_table import read_csv, write_csv
from sim_core.checks import require
from sim_core.outcomes import ENDED, Outcome

ROBOTS = (5, 10, 15, 20, 25)
"""Robots per group of the dissertation's setups (3.3)."""
GROUPS = (1, 2, 3, 4, 8)
"""Group counts of the dissertation's setups (3.3)."""
DRAWN_TRAININGS = ((5, 1), (10, 1), (5, 2), (5, 3), (10, 2), (10, 3))
"""Robots per group and groups of the trainings whose Extrapolation Figures 3.4 to 3.6 draw (M_sensor)."""
LEARNED = "learned"
"""`policy` of a trained network; a baseline's is its name."""


class ResultRow(NamedTuple):
    """Counts of one evaluation.

    Fields: preset; policy (`learned`, or a baseline's name); method, which determines the world; robots per group,
    groups and seed of the training (for a baseline: those of the evaluation, and seed 0); robots per group and groups
    of the evaluation; episodes, and how many ended in each outcome; mean length in env steps; hash of the run's config.
    """

    preset: str
    policy: str
    method: str
    trained_robots: int
    trained_groups: int
    seed: int
    robots: int
    groups: int
    episodes: int
    goal: int
    lost: int
    captured: int
    collision: int
    timeout: int
    mean_length_steps: float
    config: str

    def count(self, outcome: Outcome) -> int:
        """Number of episodes that ended in `outcome`."""
        return int(getattr(self, outcome.name.lower()))

    @property
    def is_fixed(self) -> bool:
        """Whether training and evaluation have the same setup (Fixed); otherwise it is an Extrapolation."""
        return (self.trained_robots, self.trained_groups) == (self.robots, self.groups)


def is_drawn(trained: tuple[int, int], played: tuple[int, int]) -> bool:
    """Whether a figure draws the Extrapolation from one setup (robots, groups) to another: to more of either."""
    more_robots = played[0] > trained[0] and played[1] == trained[1]
    more_groups = played[1] > trained[1] and played[0] == trained[0]
    return trained in DRAWN_TRAININGS and (more_robots or more_groups)


def write_table(path: Path, rows: Iterable[ResultRow]) -> None:
    """Writes rows in a fixed order to a CSV file; an older file is replaced once the new one is complete."""
    write_csv(path, ResultRow, rows)


def read_table(path: Path) -> list[ResultRow]:
    """Reads what `write_table` wrote.

    Raises:
      ConfigError: the file cannot be read, has other columns, or has a row with impossible counts.
    """
    rows = read_csv(path, ResultRow, "results", "name a results.csv of a sweep")
    for number, row in enumerate(rows, start=2):
        counts = [row.count(outcome) for outcome in ENDED]
        require(
            min(counts) >= 0 and sum(counts) == row.episodes >= 1,
            f"{path}, line {number} counts {sum(counts)} outcomes of {row.episodes} episodes; make the table again",
        )
    return rows
