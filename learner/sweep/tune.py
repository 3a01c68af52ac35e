"""Schedules a sweep's cells, or a search's trials, on a Ray cluster's CPUs with Ray Tune, and retries those that crash.

Tune holds no checkpoints: a cell resumes from its own. A resumed sweep is a new Tune experiment with the missing cells,
because Tune cannot change the grid of an experiment that it restores. So is a resumed search: its study knows what is
missing.
"""

from __future__ import annotations

import io
import os
import signal
import tempfile
import time
from collections.abc import Callable
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import Any, Protocol

from ray import tune
from ray.tune.schedulers import FIFOScheduler
from ray.tune.search import Searcher

from learner.ray_backend.cluster import cluster_cpus, connect, leave
from learner.ray_backend.metrics import RayMetrics
from learner.sweep.cell import SweepLocation, run_cell
from learner.sweep.grid import Cell, SweepConfig
from learner.tracking.journal import Row
from learner.training.stop_signals import stop_on_signals

ATTEMPTS = 3
"""How often a cell is started at most before it counts as failed."""
TRACE = "error.txt"
"""File in a failed cell's folder: the traceback of its last crash."""
PROGRESS = "progress/"
"""Prefix of what a trial reports, which Tune puts beside values of its own."""
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


class _Unsaved:
    """Has no state for Tune, which pickles all parts of its experiment: ours is never restored."""

    def __getstate__(self) -> dict[str, Any]:
        """Nothing."""
        return {}


def _trace_of(trial: Any) -> str:
    """What ended a trial. Tune has written it to its own folder; the copy that `get_error` reads may come later."""
    trace = ""
    with suppress(OSError, TypeError):  # TypeError: there is no such file
        trace = Path(trial.error_file).read_text("utf-8", "replace")
    return trace or "its process died"


class _Callback(_Unsaved, tune.Callback):
    """Passes Tune's events to a CellListener, and writes the traceback of a cell's last crash to its folder."""

    def __init__(self, listener: CellListener, location: SweepLocation) -> None:
        self._listener = listener
        self._location = location

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
        key, trace = trial.config["cell"], _trace_of(trial)
        path = self._location.cells / key / TRACE
        with suppress(OSError):  # the disk may be full, which may be why the cell failed
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
    trainable = tune.with_parameters(_train_cell, sweep=sweep, cells=known, location=location)
    space = {"cell": tune.grid_search(list(known))}
    _fit(trainable, tune.TuneConfig(reuse_actors=True), _Callback(listener, location), at_once, space)


def _fit(
    trainable: Any,
    config: tune.TuneConfig,
    callback: tune.Callback,
    at_once: int | None,
    space: dict[str, Any] | None = None,
) -> None:
    """Runs a Tune experiment, one CPU a trial, on the cluster that this process has joined, and leaves it."""
    config.max_concurrent_trials = at_once or cluster_cpus()  # without a limit, Tune would not keep the order
    with tempfile.TemporaryDirectory(prefix="shoal-tune-") as folder:
        tuner = tune.Tuner(
            tune.with_resources(trainable, {"cpu": 1}),
            param_space=space,
            tune_config=config,
            run_config=tune.RunConfig(
                name="cells",
                storage_path=str(Path(folder)),
                failure_config=tune.FailureConfig(max_failures=ATTEMPTS - 1),
                callbacks=[callback],
                verbose=0,
            ),
        )
        # The listener shows what Tune would print. The loss of the terminal ends a sweep as Ctrl-C does.
        with redirect_stdout(io.StringIO()), stop_on_signals(signal.SIGHUP) as stop, stop.at_once():
            tuner.fit()
    leave()


class TrialSource(Protocol):
    """Says which trials a search runs, and is told what becomes of them; every call names a trial by its number."""

    def next(self) -> tuple[int, dict[str, Any]] | None:
        """Number and settings of the next trial; None where there is none."""
        ...

    def progressed(self, number: int, progress: dict[str, Any]) -> bool:
        """A trial has reported progress; whether it goes on."""
        ...

    def finished(self, number: int) -> None:
        """A trial has run to its end."""
        ...

    def stopped(self, number: int) -> None:
        """A trial that was not to go on has ended."""
        ...

    def failed(self, number: int, trace: str) -> None:
        """A trial has crashed for the last time, with this traceback."""
        ...


Work = Callable[[int, dict[str, Any], Callable[[dict[str, Any]], None]], None]
"""What a trial does: its number, its settings, and where it reports progress."""


class _Suggestions(_Unsaved, Searcher):
    """Tune's view of a TrialSource: asks it for trials."""

    def __init__(self, source: TrialSource) -> None:
        super().__init__()
        self._source = source

    def suggest(self, trial_id: str) -> Any:
        found = self._source.next()
        return Searcher.FINISHED if found is None else {"number": found[0], "settings": found[1]}

    def on_trial_complete(self, trial_id: str, result: Any = None, error: bool = False) -> None:
        """Nothing: `_TrialCallback` tells the source."""

    def save(self, checkpoint_path: str) -> None:
        """Nothing."""

    def restore(self, checkpoint_path: str) -> None:
        """Nothing."""


class _Rungs(_Unsaved, FIFOScheduler):
    """Stops the trials that the source has no further use for."""

    def __init__(self, source: TrialSource, stopped: set[int]) -> None:
        super().__init__()
        self._source = source
        self._stopped = stopped

    def on_trial_result(self, tune_controller: Any, trial: Any, result: dict[str, Any]) -> str:
        number = trial.config["number"]
        progress = {name.removeprefix(PROGRESS): value for name, value in result.items() if name.startswith(PROGRESS)}
        if not progress or self._source.progressed(number, progress):
            return str(FIFOScheduler.CONTINUE)
        self._stopped.add(number)
        return str(FIFOScheduler.STOP)


class _TrialCallback(_Unsaved, tune.Callback):
    """Tells a TrialSource how trials end."""

    def __init__(self, source: TrialSource, stopped: set[int]) -> None:
        self._source = source
        self._stopped = stopped

    def on_trial_complete(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        number = trial.config["number"]
        (self._source.stopped if number in self._stopped else self._source.finished)(number)

    def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        if trial.status == "ERROR":
            self._source.failed(trial.config["number"], _trace_of(trial))


def _run_trial(params: dict[str, Any], work: Work) -> None:
    """Tune's trainable."""
    last_s = 0.0

    def report(progress: dict[str, Any]) -> None:
        nonlocal last_s
        now_s = time.monotonic()
        if progress.get("part") is not None or now_s - last_s >= REPORT_EVERY_S:
            last_s = now_s
            tune.report({f"{PROGRESS}{name}": value for name, value in progress.items()})

    work(params["number"], params["settings"], report)


def run_trials(work: Work, source: TrialSource, address: str | None, at_once: int | None) -> None:
    """Runs a search's trials on a Ray cluster, one CPU each, and returns when the source has no more.

    Args:
      work: what a trial does, in a process of its own.
      source: says which trials to run, and is told of them.
      address: address of a Ray cluster, None for a Ray of its own on this machine.
      at_once: how many trials run at once at most, None for one per CPU.

    Raises:
      ConfigError: see `learner.ray_backend.cluster.connect`.
    """
    connect(1, address)
    stopped: set[int] = set()
    rungs, suggestions = _Rungs(source, stopped), _Suggestions(source)
    config = tune.TuneConfig(search_alg=suggestions, scheduler=rungs, num_samples=-1, reuse_actors=True)
    _fit(tune.with_parameters(_run_trial, work=work), config, _TrialCallback(source, stopped), at_once)
