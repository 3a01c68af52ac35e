"""The results of a sweep's folder: its table, and its settings with their provenance."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from actors.evaluation.result_table import LEARNED, ResultRow, read_table, write_table
from deploy.runs.folders import make_folder
from deploy.runs.sweep_provenance import KEY, Provenance, read_provenance, sweep_command
from learner.config import to_dict
from learner.file_names import CELLS, RESULTS, SETTINGS
from learner.run_folder import write_json
from learner.sweep.grid import SweepConfig, done_cells, expected_hash, make_cells
from learner.tracking.mlflow_run import git_commit
from sim_core.checks import ConfigError


class SweepResults:
    """The results of a sweep so far: its own finished cells, and known rows of earlier sweeps.

    Args:
      grid: the sweep.
      folder: its folder, made if missing.
      known: a table of results of an earlier sweep, used in addition to the folder's own table.

    Attributes:
      left_out: rows of `known` that are of other settings and not used.

    Raises:
      ConfigError: a setup is impossible, the folder cannot be written to or holds results of other settings, or a
        table cannot be read.
    """

    def __init__(self, grid: SweepConfig, folder: Path, known: Path | None = None) -> None:
        self._grid = grid
        self.folder = folder
        self.table = folder / RESULTS
        self.cells = make_cells(grid)  # raises before a folder is made
        mine = read_table(self.table) if self.table.is_file() else []
        self._refuse_other_settings(mine)
        given = read_table(known) if known else []
        taken = [row for row in given if self._fits(row)]
        self.left_out = len(given) - len(taken)
        self._known = [*taken, *mine]
        provenance = [*(read_provenance(known) if known and taken else []), *read_provenance(self.table)]
        self._provenance = list(dict.fromkeys(provenance))
        make_folder(folder, "--runs-dir")
        self._own = {cell.key: self._read(cell.key) for cell in self.cells}

    def _fits(self, row: ResultRow) -> bool:
        """Whether a row can stand in this sweep's table: it has this sweep's settings, or another sweep's label."""
        return row.preset != self._grid.label or expected_hash(self._grid, row) == row.config

    def _refuse_other_settings(self, rows: list[ResultRow]) -> None:
        for row in rows:
            if not self._fits(row):
                raise ConfigError(
                    f"{self.table} holds results of other settings ({row.method} {row.trained_robots}r×"
                    f"{row.trained_groups}g, seed {row.seed}): give this sweep another --name, or remove the table"
                )

    def record_provenance(self) -> None:
        """Adds this command and commit to `settings.json`; called before cells run."""
        latest = Provenance(sweep_command(self._grid), git_commit())
        self._provenance = [*(each for each in self._provenance if each != latest), latest]
        self._write_settings()

    def _read(self, key: str) -> list[ResultRow]:
        table = self.folder / CELLS / key / RESULTS
        return read_table(table) if table.is_file() else []

    def _rows(self) -> list[ResultRow]:
        """All rows; of two rows of the same evaluation, the one with more episodes."""
        own = [row for rows in self._own.values() for row in rows]
        best: dict[tuple[object, ...], ResultRow] = {}
        for row in sorted([*self._known, *own], key=lambda row: row.episodes):
            policy = (row.preset, row.policy, row.method, row.trained_robots, row.trained_groups, row.seed)
            best[*policy, row.robots, row.groups] = row
        return list(best.values())

    def finished(self, key: str) -> dict[str, list[ResultRow]]:
        """Takes in the table of a cell that has just finished, and writes the sweep's; returns as `write`."""
        self._own[key] = self._read(key)
        return self._write_table()

    def write(self) -> dict[str, list[ResultRow]]:
        """Writes `results.csv`, all rows, and `settings.json`, their settings and provenance.

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
        settings = {
            "sweep": dataclasses.asdict(self._grid),
            KEY: [each._asdict() for each in self._provenance],
            "a_cell_of_each_method": examples,
        }
        write_json(self.folder / SETTINGS, settings)
