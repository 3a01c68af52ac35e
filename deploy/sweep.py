"""`shoal sweep`: trains and evaluates a grid of setups as one job that can be killed and gone on with at any moment."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

from rich.console import Console

from actors.result_table import ResultRow, read_table, write_table
from deploy.options import Sweep
from deploy.sweep_board import SweepBoard, make_board
from deploy.training import make_folder
from learner.config import to_dict
from learner.sweep import SweepConfig, done_cells, make_cells
from learner.tracker import Tracker, git_commit
from learner.trial import RESULTS, SweepPlace
from learner.tune_edge import run_cells
from sim_core.checks import require

CELLS = "cells"


class SweepResults:
    """What is done of a sweep: its own finished cells, and those of earlier sittings.

    Args:
      grid: the sweep.
      folder: its folder.
      known: results of earlier sittings.

    Raises:
      ConfigError: a setup is not possible.
    """

    def __init__(self, grid: SweepConfig, folder: Path, known: list[ResultRow]) -> None:
        self._grid = grid
        self._known = known
        self.folder = folder
        self.table = folder / RESULTS
        self.cells = make_cells(grid)

    def done(self) -> dict[str, list[ResultRow]]:
        """The results of every finished cell, by key."""
        own = [row for path in sorted((self.folder / CELLS).glob(f"*/{RESULTS}")) for row in read_table(path)]
        return done_cells(self._grid, self.cells, [*self._known, *own])

    def write(self) -> dict[str, list[ResultRow]]:
        """Writes `results.csv`, the rows of all finished cells, and `settings.json`, how they came about.

        Returns:
          See `done`.
        """
        done = self.done()
        write_table(self.table, [row for rows in done.values() for row in rows])
        examples = {cell.config.world.method: to_dict(cell.config) for cell in reversed(self.cells)}
        settings = {"sweep": dataclasses.asdict(self._grid), "commit": git_commit(), "a_cell_of_each_method": examples}
        part = self.folder / "settings.json.part"
        part.write_text(json.dumps(settings, indent=1) + "\n")
        part.replace(self.folder / "settings.json")
        return done


class _Listener:
    """Tells the board what happens and keeps the table up to date; implements `learner.tune_edge.CellListener`."""

    def __init__(self, board: SweepBoard, results: SweepResults) -> None:
        self._board = board
        self._results = results

    def started(self, key: str) -> None:
        self._board.started(key)

    def progressed(self, key: str, env_steps: int) -> None:
        self._board.progressed(key, env_steps)

    def finished(self, key: str) -> None:
        self._board.finished(key, self._results.write()[key])

    def failed(self, key: str, reason: str) -> None:
        self._board.failed(key, reason)


def sweep(command: Sweep) -> int:
    """Runs what is missing of a sweep and writes its table of results; returns the exit code."""
    launch, name = command.launch, command.launch.name or command.grid.preset
    require(
        name == Path(name).name and name not in ("", ".", ".."), f"--name must be a plain folder name, not {name!r}"
    )
    folder = (launch.runs_dir / "sweeps" / name).absolute()
    results = SweepResults(command.grid, folder, read_table(command.known) if command.known else [])
    make_folder(folder)
    console = Console(file=sys.stdout)  # by name: Tune's own output is kept from sys.stdout while it runs
    console.print(f"sweep {folder}", highlight=False, soft_wrap=True)
    done = results.write()
    board = make_board(console, results.cells, done)
    missing = [cell for cell in results.cells if cell.key not in done]
    if missing:
        place = SweepPlace(folder / CELLS, launch.tracking(), launch.sweep_experiment(name))
        # One process makes store and experiment, before several open them.
        Tracker(place.tracking_uri, place.experiment, launch.artifact_root()).set_views()
        with board:
            listener = _Listener(board, results)
            run_cells(command.grid, missing, place, launch.ray_address(), command.at_once, listener)
    return _end(console, results, board)


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
