"""Runs one cell of a sweep: trains, evaluates, and logs to the cell's MLflow run. Resumable at any time.

A cell's folder is a run's folder. Its `results.csv` is written last, and its presence means that the cell is done. The
cell's MLflow run has the cell's key as a tag: a session after a crash finds it by that tag and continues it.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from actors.evaluation.evaluation_store import StoredEvaluation, save_evaluation
from actors.evaluation.evaluator import evaluate
from actors.evaluation.result_table import LEARNED, ResultRow, read_table, write_table
from actors.policy.baselines import Baseline
from actors.policy.policy import WeightsSnapshot
from actors.rollout.vector_env import env_shape
from actors.service.messages import EpisodeStats
from learner.checkpoints.checkpoint import Checkpoint
from learner.cluster_options import ClusterOptions
from learner.config import RunConfig
from learner.export.policy_file import read_saved_policy, save_policy
from learner.file_names import EVALUATIONS
from learner.run import RunResult, RunSession, last_checkpoint
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
    if folder.results.is_file() and done_cells(sweep, [cell], read_table(folder.results)):
        return folder.results
    checkpoint = last_checkpoint(folder, cell.config)
    tracker = _start_or_resume(cell, sweep, folder, location)
    if cell.policy != LEARNED:
        with tracker.ending():
            _play_baseline(sweep, cell, folder, tracker)
    elif folder.policy.is_file() and not folder.checkpoints.exists():
        with tracker.ending():
            _evaluate_again(sweep, cell, folder, tracker)
    else:
        _train(sweep, cell, folder, location, tracker, checkpoint, on_row)  # ends the MLflow run itself
    _new_table(folder).rename(folder.results)  # once MLflow has everything and the run is ended
    shutil.rmtree(folder.checkpoints, ignore_errors=True)  # the policy and the results stay
    return folder.results


def _train(
    sweep: SweepConfig,
    cell: Cell,
    folder: RunFolder,
    location: SweepLocation,
    tracker: Tracker,
    checkpoint: Checkpoint | None,
    on_row: Callable[[Row], None],
) -> None:
    """Trains from the checkpoint or afresh, and evaluates the policy."""
    if checkpoint is None:
        tracker.skip_logged_metrics()  # of a session that left no checkpoint: the same values, measured at another time

    def finish(result: RunResult, rows: list[Row]) -> None:
        assert result.weights is not None and result.episodes is not None and result.evaluation is not None
        shape = env_shape(cell.config.env)
        save_policy(folder.policy, result.weights, cell.config, shape)
        results = _evaluate_all(sweep, cell, folder, result.weights, result.episodes)
        tracker.log_artifact(folder.policy)
        if location.registers:
            tracker.log_policy(result.weights, cell.config, shape, score(result.evaluation))
        _log_table(results, folder, tracker)

    RunSession(folder, cell.config, tracker, RowDisplay(on_row), ClusterOptions()).execute(checkpoint, finish)


def _fixed_seeds(cell: Cell) -> list[int]:
    first = cell.config.final_eval_first_seed
    return list(range(first, first + cell.config.final_eval_episodes))


def _evaluate_again(sweep: SweepConfig, cell: Cell, folder: RunFolder, tracker: Tracker) -> None:
    """Evaluates the stored policy of a cell that was done, where the sweep now asks for more setups or episodes."""
    weights = read_saved_policy(folder.policy, cell.config, env_shape(cell.config.env))
    fixed = evaluate(cell.config.env, weights, _fixed_seeds(cell))
    _log_table(_evaluate_all(sweep, cell, folder, weights, fixed), folder, tracker)


def _play_baseline(sweep: SweepConfig, cell: Cell, folder: RunFolder, tracker: Tracker) -> None:
    """Evaluates a baseline."""
    stats = evaluate(cell.config.env, Baseline(cell.policy), _fixed_seeds(cell))
    tracker.log_results(as_metrics(summarise(stats)), tracker.started_ms)
    _log_table([_stored(sweep, cell, cell.config, stats, folder, 0)], folder, tracker)


def _log_table(results: list[ResultRow], folder: RunFolder, tracker: Tracker) -> None:
    """Writes and logs the table of a cell's results, not yet in the place that marks the cell as done."""
    table = _new_table(folder)
    write_table(table, results)
    tracker.log_artifact(table)


def _new_table(folder: RunFolder) -> Path:
    return folder.artifacts / folder.results.name


def _evaluate_all(
    sweep: SweepConfig, cell: Cell, folder: RunFolder, weights: WeightsSnapshot, fixed: EpisodeStats
) -> list[ResultRow]:
    """Makes the Extrapolation evaluations, and stores them and the Fixed one; returns all rows of results."""
    config = cell.config
    results = [_stored(sweep, cell, config, fixed, folder, weights.version)]
    wanted = wanted_episodes(sweep, cell)
    for world in extrapolation_worlds(sweep, cell):
        seeds = list(range(sweep.first_seed, sweep.first_seed + wanted[world.robots, world.groups]))
        played = dataclasses.replace(config, world=world)
        results.append(_stored(sweep, cell, played, evaluate(played.env, weights, seeds), folder, weights.version))
    return results


def _stored(
    sweep: SweepConfig, cell: Cell, played: RunConfig, stats: EpisodeStats, folder: RunFolder, updates: int
) -> ResultRow:
    world = played.world
    path = folder.path / EVALUATIONS / f"{world.robots}r{world.groups}g.zarr"
    path.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(path, ignore_errors=True)  # from a session that was killed
    seeds = np.arange(sweep.first_seed, sweep.first_seed + len(stats.outcome))
    save_evaluation(path, StoredEvaluation(played.env, cell.name, updates, seeds, stats))
    return result_row(sweep, cell, world, stats)
