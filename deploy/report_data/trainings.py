"""What charts show of the trainings in run folders."""

from __future__ import annotations

import functools
from pathlib import Path

from actors.evaluation.result_table import read_table
from actors.evaluation.statistics import rate
from dashboards.analysis.aggregate import Setup
from dashboards.analysis.failure_styles import FAILURE_STYLES
from dashboards.analysis.trainings import CurvePoint, Speed, Training
from deploy.runs.learning_curve import curve_points
from learner.config import RunConfig
from learner.run_folder import RunFolder
from learner.tracking.journal import Row, read_rows
from sim_core.outcomes import OUTCOME_NAMES, Outcome

Fingerprint = tuple[tuple[str, int, int], ...]
"""Names, modification times (ns) and sizes (bytes) of files: it changes when one of them does."""


def fingerprint_of(paths: list[Path]) -> Fingerprint:
    """The fingerprint of the files that exist."""
    found = []
    for path in sorted(paths):
        try:
            status = path.stat()
        except FileNotFoundError:
            continue
        found.append((str(path), status.st_mtime_ns, status.st_size))
    return tuple(found)


def journal_rows(folder: RunFolder) -> list[Row]:
    """The rows of a run's journal; cached until the file changes."""
    return _cached_rows(folder.journal, fingerprint_of([folder.journal]))


@functools.lru_cache(maxsize=1024)
def _cached_rows(journal: Path, fingerprint: Fingerprint) -> list[Row]:
    return read_rows(journal)


def training_of(folder: RunFolder) -> Training:
    """The curve and the speeds of a run; a sweep's finished cell has its final evaluation, too."""
    config, rows = folder.config(), journal_rows(folder)
    curve = [*curve_points(rows), *_final_points(folder, config)]
    speeds = [
        Speed(row.env_steps, row.metrics["speed/env_steps_per_s"], row.metrics["speed/updates_per_s"])
        for row in rows
        if "speed/env_steps_per_s" in row.metrics
    ]
    world = config.world
    setup = Setup(world.robots, world.groups) if config.env.is_swarm else None
    is_share = all(point.failures is not None for point in curve)
    method = world.method_name if config.env.is_swarm else ""
    return Training(config.name, method, setup, config.seed, curve, speeds, is_share)


def _final_points(folder: RunFolder, config: RunConfig) -> list[CurvePoint]:
    """The final evaluation in the table of a sweep's finished cell; none elsewhere."""
    rows = read_table(folder.results) if folder.results.is_file() else []
    return [
        CurvePoint(
            config.total_env_steps,
            *rate(row.goal, row.episodes),
            {name: row.count(Outcome(OUTCOME_NAMES.index(name))) / row.episodes for name in FAILURE_STYLES},
        )
        for row in rows
        if row.is_fixed
    ]
