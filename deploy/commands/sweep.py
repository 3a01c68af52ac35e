"""`shoal sweep`: trains and evaluates a grid of setups as one job that can be killed and gone on with at any moment."""

from __future__ import annotations

import dataclasses
import fcntl
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console

from actors.evaluation.result_table import LEARNED, ResultRow, read_table, write_table
from deploy.console.sweep_board import SweepBoard, make_board
from deploy.options.training import Sweep
from deploy.runs.folders import check_lasting, check_plain_name, make_folder
from deploy.runs.sweep_provenance import Sitting, read_sittings, sweep_command
from learner.config import to_dict
from learner.file_names import CELLS, LOCK, RESULTS, SETTINGS, SWEEPS
from learner.run_folder import write_json
from learner.sweep.cell import SweepPlace
from learner.sweep.grid import Cell, SweepConfig, done_cells, expected_hash, make_cells
from learner.sweep.tune import run_cells
from learner.tracking.mlflow_run import Tracker, git_commit
from sim_core.checks import ConfigError


class SweepResults:
    """What is done of a sweep: its own finished cells, and those of earlier sittings.

    Args:
      grid: the sweep.
      folder: its folder, made if missing.
      known: a table of results of earlier sittings, beside those that the folder's table holds already.

    Raises:
      ConfigError: a setup is not possible, the folder cannot be written to or holds results of other settings, or a
        table cannot be read.
    """

    def __init__(self, grid: SweepConfig, folder: Path, known: Path | None = None) -> None:
        self._grid = grid
        self.folder = folder
        self.table = folder / RESULTS
        self.cells = make_cells(grid)  # refuses what cannot be, before a folder is made
        mine = read_table(self.table) if self.table.is_file() else []
        self._refuse_other_settings(mine)
        given = read_table(known) if known else []
        taken = [row for row in given if self._fits(row)]
        self.left_out = len(given) - len(taken)
        self._known = [*taken, *mine]
        sittings = [*(read_sittings(known) if known and taken else []), *read_sittings(self.table)]
        self._sittings = list(dict.fromkeys(sittings))
        make_folder(folder, "--runs-dir")
        self._own = {cell.key: self._read(cell.key) for cell in self.cells}

    def _fits(self, row: ResultRow) -> bool:
        """Whether a row is of another label, or of this sweep's settings."""
        return row.preset != self._grid.label or expected_hash(self._grid, row) == row.config

    def _refuse_other_settings(self, rows: list[ResultRow]) -> None:
        for row in rows:
            if not self._fits(row):
                raise ConfigError(
                    f"{self.table} holds results of other settings ({row.method} {row.trained_robots}r×"
                    f"{row.trained_groups}g, seed {row.seed}): give this sweep a name of its own with --name, or take "
                    "the table away"
                )

    def begin_sitting(self) -> None:
        """Notes in `settings.json` that cells are about to run."""
        sitting = Sitting(sweep_command(self._grid), git_commit())
        self._sittings = [*(each for each in self._sittings if each != sitting), sitting]
        self._write_settings()

    def _read(self, key: str) -> list[ResultRow]:
        table = self.folder / CELLS / key / RESULTS
        return read_table(table) if table.is_file() else []

    def _rows(self) -> list[ResultRow]:
        """All rows: of two of the same evaluation the one of more episodes."""
        own = [row for rows in self._own.values() for row in rows]
        best: dict[tuple[object, ...], ResultRow] = {}
        for row in sorted([*self._known, *own], key=lambda row: row.episodes):
            policy = (row.preset, row.policy, row.method, row.trained_robots, row.trained_groups, row.seed)
            best[*policy, row.robots, row.groups] = row
        return list(best.values())

    def finished(self, key: str) -> dict[str, list[ResultRow]]:
        """Reads the table of a cell that has just finished, and writes that of all; see `write`."""
        self._own[key] = self._read(key)
        return self._write_table()

    def write(self) -> dict[str, list[ResultRow]]:
        """Writes `results.csv`, all rows of the sweep's sittings, and `settings.json`, how they came about.

        Returns:
          The results of every finished cell, by key.
        """
        self._write_settings()
        return self._write_table()

    def _write_table(self) -> dict[str, list[ResultRow]]:
        rows = self._rows()
        write_table(self.table, rows)
        return done_cells(self._grid, self.cells, rows)

    def _write_settings(self) -> None:
        trained = [cell.config for cell in self.cells if cell.policy == LEARNED]
        examples = {config.world.method_name: to_dict(config) for config in reversed(trained)}
        sittings = [sitting._asdict() for sitting in self._sittings]
        settings = {
            "sweep": dataclasses.asdict(self._grid),
            "sittings": sittings,
            "a_cell_of_each_method": examples,
        }
        write_json(self.folder / SETTINGS, settings)


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Holds the sweep's folder, so that no two commands run its cells at once.

    Raises:
      ConfigError: another command holds it.
    """
    with (folder / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ConfigError(f"another `shoal sweep` is at work in {folder}; wait for it or end it") from error
        yield


class _Listener:
    """Tells the board what happens and keeps the table up to date; implements `learner.sweep.tune.CellListener`."""

    def __init__(self, board: SweepBoard, results: SweepResults) -> None:
        self._board = board
        self._results = results

    def started(self, key: str) -> None:
        self._board.started(key)

    def progressed(self, key: str, env_steps: int) -> None:
        self._board.progressed(key, env_steps)

    def finished(self, key: str) -> None:
        done = self._results.finished(key)
        if key in done:
            self._board.finished(key, done[key])
        else:
            self._board.failed(key, "its table of results is not whole")

    def failed(self, key: str, reason: str) -> None:
        self._board.failed(key, reason)


def sweep_name(command: Sweep) -> str:
    """Name of the sweep's folder: the given one, or what its preset and settings say."""
    return command.launch.name or re.sub(r"[^\w.+=-]+", "-", command.grid.label)


def sweep(command: Sweep) -> int:
    """Runs what is missing of a sweep and writes its table of results; returns the exit code."""
    launch, name = command.launch, sweep_name(command)
    check_lasting(launch.runs_dir)
    check_plain_name(name)
    folder = (launch.runs_dir / SWEEPS / name).absolute()
    results = SweepResults(command.grid, folder, command.known)
    console = Console(file=sys.stdout)  # by name: Tune's own output is kept from sys.stdout while it runs
    console.print(f"sweep {folder}", highlight=False, soft_wrap=True)
    if results.left_out:
        console.print(f"{results.left_out} rows of {command.known} are of other settings and left out", highlight=False)
    with _alone_in(folder):
        done = results.write()
        board = make_board(console, results.cells, done)
        missing = [cell for cell in results.cells if cell.key not in done]
        if missing:
            _run(command, name, results, missing, board)
        return _end(console, results, board)


def _run(command: Sweep, name: str, results: SweepResults, missing: list[Cell], board: SweepBoard) -> None:
    launch = command.launch
    place = SweepPlace(results.folder / CELLS, launch.tracking(), launch.sweep_experiment(name))
    # One process makes store and experiment, before several open them.
    Tracker(place.tracking_uri, place.experiment, launch.artifact_root()).set_views()
    results.begin_sitting()
    with board:
        listener = _Listener(board, results)
        run_cells(command.grid, missing, place, launch.ray_address(), command.at_once, listener)


def _end(console: Console, results: SweepResults, board: SweepBoard) -> int:
    done = results.write()
    console.print(board.table())
    for reason in board.failures():
        console.print(f"failed: {reason}", markup=False, highlight=False, soft_wrap=True)
    console.print(f"{len(done)} of {len(results.cells)} cells: {results.table}", highlight=False, soft_wrap=True)
    if len(done) < len(results.cells):
        console.print("the same command runs what is missing", highlight=False)
        return 1
    console.print(f"report: shoal report {results.table}", highlight=False, soft_wrap=True)
    return 0
