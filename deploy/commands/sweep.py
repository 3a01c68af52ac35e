"""`shoal sweep`: trains and evaluates a grid of setups; after a kill, the same command runs what is missing."""

from __future__ import annotations

import sys

from rich.console import Console

from deploy.console.sweep_display import SweepDisplay, make_sweep_display
from deploy.console.terminal import plain_console
from deploy.options.training import Sweep
from deploy.runs.folders import check_outlasts_job, check_plain_name, default_sweep_name, locked
from deploy.runs.sweep_results import SweepResults
from learner.file_names import CELLS, SWEEPS
from learner.sweep.cell import SweepLocation
from learner.sweep.grid import Cell
from learner.sweep.tune import run_cells
from learner.tracking.mlflow_run import Tracker


class _Listener:
    """Updates the display and the table as cells run; implements `learner.sweep.tune.CellListener`."""

    def __init__(self, display: SweepDisplay, results: SweepResults) -> None:
        self._display = display
        self._results = results

    def started(self, key: str) -> None:
        self._display.started(key)

    def progressed(self, key: str, env_steps: int) -> None:
        self._display.progressed(key, env_steps)

    def finished(self, key: str) -> None:
        done = self._results.finished(key)
        if key in done:
            self._display.finished(key, done[key])
        else:
            self._display.failed(key, "its table of results is incomplete")

    def failed(self, key: str, reason: str) -> None:
        self._display.failed(key, reason)


def run(command: Sweep) -> int:
    """Runs a sweep's missing cells and writes its table of results; returns the exit code, 1 if cells are missing.

    Raises:
      ConfigError: the name or the folder cannot be used, another command runs the sweep, or see `SweepResults`.
    """
    launch = command.launch
    name = launch.name or default_sweep_name(command.grid)
    check_outlasts_job(launch.runs_dir)
    check_plain_name(name)
    folder = (launch.runs_dir / SWEEPS / name).absolute()
    results = SweepResults(command.grid, folder, command.known)
    console = plain_console(file=sys.stdout)  # explicitly: sys.stdout is replaced while Tune runs, to drop its output
    console.print(f"sweep {folder}", soft_wrap=True)
    if results.left_out:
        console.print(f"{results.left_out} rows of {command.known} are of other settings and left out", soft_wrap=True)
    with locked(folder, "sweep"):
        done = results.write()
        display = make_sweep_display(console, results.cells, done)
        missing = [cell for cell in results.cells if cell.key not in done]
        if missing:
            _run_missing(command, name, results, missing, display)
        return _finish(console, results, display)


def _run_missing(command: Sweep, name: str, results: SweepResults, missing: list[Cell], display: SweepDisplay) -> None:
    launch = command.launch
    location = SweepLocation(results.folder / CELLS, launch.tracking(), launch.experiment_of("sweep", name))
    # Makes the store and the experiment here, before several processes open them.
    Tracker(location.tracking_uri, location.experiment, launch.artifact_root())
    results.record_provenance()
    with display:
        listener = _Listener(display, results)
        run_cells(command.grid, missing, location, launch.ray_address(), command.at_once, listener)


def _finish(console: Console, results: SweepResults, display: SweepDisplay) -> int:
    done = results.write()
    console.print(display.table())
    for reason in display.failures():
        console.print(f"failed: {reason}", soft_wrap=True)
    console.print(f"{len(done)} of {len(results.cells)} cells: {results.table}", soft_wrap=True)
    if len(done) < len(results.cells):
        console.print("the same command runs what is missing")
        return 1
    console.print(f"report: shoal report {results.table}", soft_wrap=True)
    return 0
