"""Runs one cell of a sweep: trains, evaluates, and logs to the cell's MLflow run. Resumable at any time.

A cell's folder is a run's folder. Its `results.csv` is written last, and its presence means that the cell is done. The
cell's MLflow run has the cell's key as a tag: a session after a crash finds it by that tag and continues it.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from actors.evaluation.evaluation_store import stored_or_played
from actors.evaluation.evaluator import evaluate
from actors.evaluation.result_table import LEARNED, ResultRow, read_table, write_table
from actors.policy.baselines import Baseline
from actors.policy.policy import WeightsSnapshot
from actors.rollout.vector_env import env_shape
from actors.service.fault_policy import RunFailed
from actors.service.messages import EpisodeStats
from learner.checkpoints.checkpoint import Checkpoint
from learner.cluster_options import ClusterOptions
from learner.config import RunConfig
from learner.export.saved_policy import read_saved_policy, save_policy
from learner.file_names import EVALUATIONS
from learner.run import RunResult, RunSession, Step, last_checkpoint
from learner.run_end import RunEnd, discard_end, final_seeds
from learner.run_folder import RunFolder, RunIdentity
from learner.sweep.grid import Cell, SweepConfig, cell_hash, done_cells, extrapolation_worlds, wanted_episodes
from learner.tracking.journal import Row
from learner.tracking.mlflow_run import Tracker
from learner.tracking.redaction import public_uri
from learner.training.evaluation_summary import as_metrics, score, summarise
from sim_core.config import WorldConfig
from sim_core.outcomes import ENDED


class SweepLocation(NamedTuple):
    """Where a sweep stores its cells, and where it logs them: MLflow tracking URI and experiment.

    `registers` says whether policies become versions of MLflow's registered models, which rank them.
    """

    cells: Path
    tracking_uri: str
    experiment: str
    registers: bool = True

    @property
    def sweep(self) -> str:
        """The sweep's name, which is the name of its folder."""
        return self.cells.parent.name


class RowDisplay:
    """Passes a run's rows on and drops its messages; implements `learner.tracking.observer.Display`.

    Args:
      on_row: called with every row.
    """

    def __init__(self, on_row: Callable[[Row], None]) -> None:
        self._on_row = on_row

    def row(self, row: Row) -> None:
        """Passes the row on."""
        self._on_row(row)

    def message(self, text: str) -> None:
        """Drops the message."""


def result_row(sweep: SweepConfig, cell: Cell, played: WorldConfig, stats: EpisodeStats) -> ResultRow:
    """The row of one evaluation of a cell's policy, which played in the world `played`."""
    config = cell.config
    counts = {kind.name.lower(): int((stats.outcome == kind).sum()) for kind in ENDED}
    return ResultRow(
        preset=sweep.label,
        policy=cell.policy,
        method=played.method_name,
        trained_robots=config.world.robots,
        trained_groups=config.world.groups,
        seed=config.seed,
        robots=played.robots,
        groups=played.groups,
        episodes=len(stats.outcome),
        **counts,
        mean_length_steps=round(float(np.mean(stats.length_steps)), 2),
        config=cell_hash(config),
    )


def _start_or_resume(cell: Cell, sweep: SweepConfig, folder: RunFolder, location: SweepLocation) -> Tracker:
    """The cell's MLflow run: the one that has the cell's key and sweep as tags, or a new one."""
    tracker = Tracker(location.tracking_uri, location.experiment, None)
    known = tracker.find_run({"cell": cell.key, "sweep": location.sweep})
    if known:
        tracker.resume(known)
        tracker.log_inputs(cell.config)  # a kill may have prevented it
    else:
        tracker.start(cell.config, {"sweep": location.sweep} | _tags(cell, sweep))
    folder.save_config(cell.config)
    folder.save_identity(RunIdentity(cell.name, public_uri(tracker.uri), location.experiment, tracker.run_id))
    return tracker


def _tags(cell: Cell, sweep: SweepConfig) -> dict[str, str]:
    return {
        "cell": cell.key,
        "preset": sweep.label,
        "policy": cell.policy,
        "setup": cell.config.world.setup,
        "mlflow.runName": cell.name,
    }


def run_cell(sweep: SweepConfig, cell: Cell, location: SweepLocation, on_row: Callable[[Row], None]) -> Path:
    """Trains and evaluates a cell in this process, or resumes it from its last checkpoint.

    Args:
      sweep: the sweep.
      cell: one of its cells.
      location: where the sweep stores and logs its cells.
      on_row: called with every row of training metrics.

    Returns:
      Path of the cell's table of results.
    """
    folder = RunFolder(location.cells / cell.key)
    if folder.results.is_file():
        _remove_training(folder)  # a kill may have prevented it
        if done_cells(sweep, [cell], read_table(folder.results)):
            return folder.results
    end = RunEnd.open(folder.end, cell.config) if cell.policy == LEARNED else None
    checkpoint = last_checkpoint(folder, cell.config) if end is None else None
    tracker = _start_or_resume(cell, sweep, folder, location)
    if cell.policy != LEARNED:
        with tracker.ending():
            _play_baseline(sweep, cell, folder, tracker)
    elif end is None and folder.policy.is_file() and not folder.checkpoints.exists():
        with tracker.ending():
            _evaluate_again(sweep, cell, folder, tracker)
    else:
        if end is None:
            _prepare_training(folder, tracker, checkpoint)
        _train(sweep, cell, folder, location, tracker, checkpoint, on_row)  # ends the MLflow run itself
    _new_table(folder).rename(folder.results)  # once MLflow has everything and the run is ended
    _remove_training(folder)
    return folder.results


def _remove_training(folder: RunFolder) -> None:
    """Removes what only a resumed training needs; the policy and the results of a cell that is done stay."""
    shutil.rmtree(folder.checkpoints, ignore_errors=True)
    discard_end(folder.end)


def _prepare_training(folder: RunFolder, tracker: Tracker, checkpoint: Checkpoint | None) -> None:
    """Removes evaluations of an older policy; logs no metric twice if a session that left no checkpoint logged some."""
    shutil.rmtree(folder.path / EVALUATIONS, ignore_errors=True)
    if checkpoint is None:
        tracker.skip_logged_metrics()  # the same values, measured at another time


def _train(
    sweep: SweepConfig,
    cell: Cell,
    folder: RunFolder,
    location: SweepLocation,
    tracker: Tracker,
    checkpoint: Checkpoint | None,
    on_row: Callable[[Row], None],
) -> None:
    """Trains from the checkpoint or afresh, and evaluates the policy; goes on where an earlier session got to.

    Raises:
      RunFailed: MLflow or the disk does not take the results, or that they are all.
    """

    def steps(result: RunResult, rows: list[Row]) -> list[Step]:
        weights, episodes, evaluation = result.weights, result.episodes, result.evaluation
        assert weights is not None and episodes is not None and evaluation is not None
        shape = env_shape(cell.config.env)

        def log_file() -> None:
            save_policy(folder.policy, weights)
            tracker.log_artifact(folder.policy)

        def log_policy() -> None:
            if location.registers:
                tracker.log_policy(weights, cell.config, shape, score(evaluation))

        def log_table() -> None:
            _log_table(_evaluate_all(sweep, cell, folder, weights, lambda: episodes), folder, tracker)

        return [
            Step("the policy's file", log_file),
            Step("the policy", log_policy),
            Step("the table of results", log_table),
        ]

    result = RunSession(folder, cell.config, tracker, RowDisplay(on_row), ClusterOptions()).execute(checkpoint, steps)
    if not result.is_known:
        raise RunFailed(f"MLflow does not know that {cell.name} is finished; the same `shoal sweep` tells it")


def _evaluate_again(sweep: SweepConfig, cell: Cell, folder: RunFolder, tracker: Tracker) -> None:
    """Evaluates the stored policy of a cell that was done, where the sweep now asks for more setups or episodes."""
    weights = read_saved_policy(folder.policy, cell.config, env_shape(cell.config.env))
    fixed = partial(evaluate, cell.config.env, weights, final_seeds(cell.config))
    _log_table(_evaluate_all(sweep, cell, folder, weights, fixed), folder, tracker)


def _play_baseline(sweep: SweepConfig, cell: Cell, folder: RunFolder, tracker: Tracker) -> None:
    """Evaluates a baseline."""
    play = partial(evaluate, cell.config.env, Baseline(cell.policy), final_seeds(cell.config))
    stats = _stored(cell, cell.config, folder, 0, final_seeds(cell.config), play)
    tracker.log_results(as_metrics(summarise(stats)), tracker.started_ms)
    _log_table([result_row(sweep, cell, cell.config.world, stats)], folder, tracker)


def _log_table(results: list[ResultRow], folder: RunFolder, tracker: Tracker) -> None:
    """Writes and logs the table of a cell's results, not yet in the place that marks the cell as done."""
    table = _new_table(folder)
    write_table(table, results)
    tracker.log_artifact(table)


def _new_table(folder: RunFolder) -> Path:
    return folder.artifacts / folder.results.name


def _evaluate_all(
    sweep: SweepConfig,
    cell: Cell,
    folder: RunFolder,
    weights: WeightsSnapshot,
    play_fixed: Callable[[], EpisodeStats],
) -> list[ResultRow]:
    """Makes the Fixed and the Extrapolation evaluations that are not stored yet; returns all rows of results."""
    config, updates = cell.config, weights.version
    stats = _stored(cell, config, folder, updates, final_seeds(cell.config), play_fixed)
    results = [result_row(sweep, cell, config.world, stats)]
    wanted = wanted_episodes(sweep, cell)
    for world in extrapolation_worlds(sweep, cell):
        seeds = list(range(sweep.first_seed, sweep.first_seed + wanted[world.robots, world.groups]))
        played = dataclasses.replace(config, world=world)
        stats = _stored(cell, played, folder, updates, seeds, partial(evaluate, played.env, weights, seeds))
        results.append(result_row(sweep, cell, world, stats))
    return results


def _stored(
    cell: Cell,
    played: RunConfig,
    folder: RunFolder,
    updates: int,
    seeds: list[int],
    play: Callable[[], EpisodeStats],
) -> EpisodeStats:
    world = played.world
    path = folder.path / EVALUATIONS / f"{world.robots}r{world.groups}g.zarr"
    path.parent.mkdir(parents=True, exist_ok=True)
    return stored_or_played(path, played.env, cell.name, updates, seeds, play)
