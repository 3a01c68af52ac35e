"""Schedules a sweep's cells on a Ray cluster's CPUs with Ray Tune, and retries those that crash.

Tune holds no checkpoints: a cell resumes from its own. A resumed sweep is a new Tune experiment with the missing cells,
because Tune cannot change the grid of an experiment that it restores.
"""

from __future__ import annotations

import io
import os
import tempfile
import time
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, Protocol

from ray import tune

from learner.ray_backend.cluster import cluster_cpus, connect, leave
from learner.ray_backend.metrics import RayMetrics
from learner.sweep.cell import SweepLocation, run_cell
from learner.sweep.grid import Cell, SweepConfig
from learner.tracking.journal import Row

ATTEMPTS = 3
"""How often a cell is started at most before it counts as failed."""
TRACE = "error.txt"
"""File in a failed cell's folder: the traceback of its last crash."""
REPORT_EVERY_S = 2.0
"""Minimum time between two reports of a cell."""

os.environ.setdefault("TUNE_DISABLE_AUTO_CALLBACK_LOGGERS", "1")  # cells write results themselves
os.environ.setdefault(
    "RAY_CHDIR_TO_TRIAL_DIR", "0"
)  # relative paths are relative to the same folder in a cell and in the driver
os.environ.setdefault("TUNE_DISABLE_SIGINT_HANDLER", "1")  # Ctrl-C ends a sweep at once: it can be resumed


class CellListener(Protocol):
    """Is notified of cells while a sweep runs; every call names the cell by its key."""

    def started(self, key: str) -> None:
        """A cell has started, perhaps again."""
        ...

    def progressed(self, key: str, env_steps: int) -> None:
        """A cell has trained to `env_steps`."""
        ...

    def finished(self, key: str) -> None:
        """A cell is done, and its results are written."""
        ...

    def failed(self, key: str, reason: str) -> None:
        """A cell has crashed for the last time."""
        ...


class _Reporter:
    """Reports a cell's rows to Ray's metrics and, at limited rate, to Tune."""

    def __init__(self, key: str) -> None:
        self._metrics = RayMetrics(key)
        self._last_s = 0.0

    def __call__(self, row: Row) -> None:
        self._metrics.row(row)
        now_s = time.monotonic()
        if now_s - self._last_s >= REPORT_EVERY_S:
            self._last_s = now_s
            tune.report({"env_steps": row.env_steps})


def _train_cell(params: dict[str, Any], sweep: SweepConfig, cells: dict[str, Cell], location: SweepLocation) -> None:
    """Tune's trainable."""
    run_cell(sweep, cells[params["cell"]], location, _Reporter(params["cell"]))


class _Callback(tune.Callback):
    """Passes Tune's events to a CellListener, and writes the traceback of a cell's last crash to its folder."""

    def __init__(self, listener: CellListener, location: SweepLocation) -> None:
        self._listener = listener
        self._location = location

    def __getstate__(self) -> dict[str, Any]:
        """Nothing: Tune pickles its callbacks with its experiment, which is never restored here."""
        return {}

    def on_trial_start(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        self._listener.started(trial.config["cell"])

    def on_trial_result(
        self, iteration: int, trials: list[Any], trial: Any, result: dict[str, Any], **info: Any
    ) -> None:
        if "env_steps" in result:
            self._listener.progressed(trial.config["cell"], result["env_steps"])

    def on_trial_complete(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        self._listener.finished(trial.config["cell"])

    def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        if trial.status != "ERROR":
            return
        key, trace = trial.config["cell"], str(trial.get_error() or "its process died")
        path = self._location.cells / key / TRACE
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(trace + "\n")
        lines = [line for line in trace.splitlines() if line.strip()]
        self._listener.failed(key, f"{lines[-1]} (trace in {path})")


def run_cells(
    sweep: SweepConfig,
    cells: list[Cell],
    location: SweepLocation,
    address: str | None,
    at_once: int | None,
    listener: CellListener,
) -> None:
    """Runs cells on a Ray cluster, one CPU each, and returns when all have finished or failed.

    Args:
      sweep: the sweep.
      cells: those of its cells that are to run, in order.
      location: where they are stored and logged; every node must be able to access it.
      address: address of a Ray cluster, None for a Ray of its own on this machine.
      at_once: how many cells run at once at most, None for one per CPU.
      listener: is notified of the cells.

    Raises:
      ConfigError: see `learner.ray_backend.cluster.connect`.
    """
    connect(1, address)
    known = {cell.key: cell for cell in cells}
    at_once = at_once or cluster_cpus()  # without a limit, Tune would not keep the order of the cells
    trainable = tune.with_parameters(_train_cell, sweep=sweep, cells=known, location=location)
    with tempfile.TemporaryDirectory(prefix="shoal-tune-") as folder:
        tuner = tune.Tuner(
            tune.with_resources(trainable, {"cpu": 1}),
            param_space={"cell": tune.grid_search(list(known))},
            tune_config=tune.TuneConfig(max_concurrent_trials=at_once, reuse_actors=True),
            run_config=tune.RunConfig(
                name="cells",
                storage_path=str(Path(folder)),
                failure_config=tune.FailureConfig(max_failures=ATTEMPTS - 1),
                callbacks=[_Callback(listener, location)],
                verbose=0,
            ),
        )
        with redirect_stdout(io.StringIO()):  # the listener shows what Tune would print
            tuner.fit()
    leave()
