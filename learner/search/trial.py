"""One trial of a search: trains the cells of its small sweep one after the other, and reads what they gave."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from actors.evaluation.result_table import ResultRow, read_table
from learner.run_folder import RunFolder
from learner.search.config import EVALUATIONS, SearchConfig
from learner.search.space import Value
from learner.sweep.cell import SweepLocation, run_cell
from learner.sweep.grid import Cell
from learner.tracking.journal import Row, read_rows

SUCCESS = "eval/success_rate"


class Progress(NamedTuple):
    """How far a trial has come: env steps of all its cells; at an evaluation, its place and the mean success so far."""

    env_steps: int
    part: int | None = None
    success: float = 0.0


class TrialResult(NamedTuple):
    """What an objective is computed from.

    Fields: the trial's number; its settings by name; the rows of its cells' tables, counts of greedy episodes; for each
    cell the evaluations during training as (env steps, success); the folder with the cells' folders.
    """

    number: int
    settings: dict[str, Value]
    rows: list[ResultRow]
    curves: list[list[tuple[int, float]]]
    folder: Path


def run_trial(
    search: SearchConfig, settings: dict[str, Value], location: SweepLocation, report: Callable[[Progress], None]
) -> None:
    """Trains and evaluates a trial's cells in this process, or resumes them from their last checkpoints.

    Args:
      search: the search.
      settings: the trial's settings.
      location: where its cells are stored and logged.
      report: called with the progress.
    """
    sweep, cells = search.cells(settings)
    before_steps, finished = 0, list[float]()
    for place, cell in enumerate(cells):
        watch = _Watch(place, cell, before_steps, finished, report)
        rows = read_table(run_cell(sweep, cell, location, watch))
        finished.append(next(row.goal / row.episodes for row in rows if row.is_fixed))
        before_steps += cell.config.total_env_steps
        report(Progress(before_steps))


class _Watch:
    """Turns the rows of one cell's training into the progress of its trial."""

    def __init__(
        self, place: int, cell: Cell, before_steps: int, finished: list[float], report: Callable[[Progress], None]
    ) -> None:
        self._place = place
        self._every_steps = cell.config.eval_every_env_steps
        self._total_steps = cell.config.total_env_steps
        self._before_steps = before_steps
        self._finished = finished
        self._report = report

    def __call__(self, row: Row) -> None:
        env_steps = self._before_steps + row.env_steps
        if SUCCESS not in row.metrics or row.env_steps >= self._total_steps:
            self._report(Progress(env_steps))
            return
        part = EVALUATIONS * self._place + max(1, row.env_steps // self._every_steps)
        mean = (sum(self._finished) + row.metrics[SUCCESS]) / (self._place + 1)
        self._report(Progress(env_steps, part, mean))


def read_result(number: int, settings: dict[str, Value], cells: list[Cell], folder: Path) -> TrialResult:
    """What a finished trial gave.

    Args:
      number: the trial's.
      settings: the trial's.
      cells: its cells.
      folder: of the cells' folders.
    """
    runs = [RunFolder(folder / cell.key) for cell in cells]
    return TrialResult(
        number=number,
        settings=settings,
        rows=[row for run in runs for row in read_table(run.results)],
        curves=[_curve(run) for run in runs],
        folder=folder,
    )


def _curve(run: RunFolder) -> list[tuple[int, float]]:
    rows = read_rows(run.journal) if run.journal.is_file() else []
    return [(row.env_steps, row.metrics[SUCCESS]) for row in rows if SUCCESS in row.metrics]
