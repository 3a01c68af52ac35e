"""One cell of a sweep, from its training to its results, resumable at any moment.

A cell's folder is a run's folder with `results.csv` in it, written last: where it stands, the cell is done. Its
MLflow run is found again by the cell's key, so that no crash makes a second one.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from actors.evaluation_store import StoredEvaluation, save_evaluation
from actors.evaluator import evaluate
from actors.network import WeightsSnapshot
from actors.result_table import LEARNED, ResultRow, write_table
from actors.transitions import EpisodeStats
from actors.vector_env import env_shape
from learner.checkpoint import Checkpoint, CheckpointError
from learner.config import RunConfig
from learner.journal import Row
from learner.policy_file import save_policy
from learner.run import RunResult, execute, resume_point
from learner.run_folder import RunFolder, RunIdentity
from learner.sweep import Cell, SweepConfig, cell_hash, other_worlds
from learner.tracker import Tracker
from sim_core.config import WorldConfig
from sim_core.outcomes import ENDED

RESULTS = "results.csv"
EVALUATIONS = "evaluations"


class SweepPlace(NamedTuple):
    """Where a sweep's cells lie and are logged."""

    cells: Path
    tracking_uri: str
    experiment: str


class RowDisplay:
    """Passes a run's rows on; implements `learner.run.Display`.

    Args:
      on_row: is called with every row.
    """

    def __init__(self, on_row: Callable[[Row], None]) -> None:
        self._on_row = on_row

    def row(self, row: Row) -> None:
        """Passes the row on."""
        self._on_row(row)

    def message(self, text: str) -> None:
        """A cell says nothing."""


def result_row(sweep: SweepConfig, config: RunConfig, played: WorldConfig, stats: EpisodeStats) -> ResultRow:
    """The row of one evaluation: the policy that `config` trained, in the world `played`."""
    counts = {kind.name.lower(): int((stats.outcome == kind).sum()) for kind in ENDED}
    return ResultRow(
        preset=sweep.label,
        policy=LEARNED,
        method=played.method,
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


def _start_or_find(cell: Cell, sweep: SweepConfig, folder: RunFolder, place: SweepPlace) -> Tracker:
    """The cell's MLflow run: that of its folder, or one that carries its key, or a new one."""
    tracker = Tracker(place.tracking_uri, place.experiment, None)
    known = tracker.find_run("cell", cell.key)
    if known:
        tracker.resume(known)
    else:
        tracker.start(cell.config, _tags(cell, sweep))
    folder.save_config(cell.config)
    folder.save_identity(RunIdentity(cell.config.name, tracker.uri, place.experiment, tracker.run_id))
    return tracker


def _tags(cell: Cell, sweep: SweepConfig) -> dict[str, str]:
    return {"cell": cell.key, "preset": sweep.label, "setup": cell.config.world.setup}


def _checkpoint(folder: RunFolder, config: RunConfig) -> Checkpoint | None:
    try:
        return resume_point(folder, config)[0]
    except CheckpointError:
        return None  # killed before its first one


def run_cell(sweep: SweepConfig, cell: Cell, place: SweepPlace, on_row: Callable[[Row], None]) -> Path:
    """Trains and evaluates a cell in this process, from where an earlier attempt was.

    Args:
      sweep: the sweep.
      cell: one of its cells.
      place: where it lies.
      on_row: is called with every row of training metrics.

    Returns:
      The cell's table of results.
    """
    folder = RunFolder(place.cells / cell.key)
    table = folder.path / RESULTS
    if table.is_file():
        return table
    tracker = _start_or_find(cell, sweep, folder, place)

    def finish(result: RunResult, rows: list[Row]) -> None:
        assert result.weights is not None and result.episodes is not None
        save_policy(folder.policy, result.weights, cell.config, env_shape(cell.config.env))
        results = _evaluate_all(sweep, cell, folder, result.weights, result.episodes)
        tracker.artifact(folder.policy)
        part = folder.artifacts / RESULTS
        write_table(part, results)
        tracker.artifact(part)
        part.replace(table)

    execute(folder, cell.config, tracker, RowDisplay(on_row), _checkpoint(folder, cell.config), None, finish)
    shutil.rmtree(folder.checkpoints, ignore_errors=True)  # the policy and the results stay
    return table


def _evaluate_all(
    sweep: SweepConfig, cell: Cell, folder: RunFolder, weights: WeightsSnapshot, fixed: EpisodeStats
) -> list[ResultRow]:
    """Stores the Fixed evaluation, makes and stores the Extrapolations, and counts them all."""
    config = cell.config
    results = [_stored(sweep, config, config, fixed, folder, weights.version)]
    seeds = list(range(sweep.first_seed, sweep.first_seed + sweep.extrapolation_episodes))
    for world in other_worlds(sweep, cell):
        played = dataclasses.replace(config, world=world)
        results.append(_stored(sweep, played, config, evaluate(played.env, weights, seeds), folder, weights.version))
    return results


def _stored(
    sweep: SweepConfig, played: RunConfig, trained: RunConfig, stats: EpisodeStats, folder: RunFolder, updates: int
) -> ResultRow:
    world = played.world
    path = folder.path / EVALUATIONS / f"{world.robots}r{world.groups}g.zarr"
    path.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(path, ignore_errors=True)  # of an attempt that did not come to its end
    seeds = np.arange(sweep.first_seed, sweep.first_seed + len(stats.outcome))
    save_evaluation(path, StoredEvaluation(played.env, trained.name, updates, seeds, stats))
    return result_row(sweep, trained, world, stats)
