"""How long a trial takes, from rates that are measured here and now: for `shoal search --dry-run`."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from contextlib import closing
from pathlib import Path

import numpy as np

from actors.evaluation.evaluator import evaluate
from actors.evaluation.result_table import LEARNED
from actors.policy.baselines import Baseline, exists
from actors.service.fault_policy import ComponentFailed, Decision, Recovered
from actors.storage.uri import Location
from learner.config import RunConfig
from learner.loop import TrainingLoop
from learner.search.config import SearchConfig, draw
from learner.search.space import Value
from learner.sweep.grid import Cell
from learner.tracking.journal import Journal, Row
from learner.training.cluster import ProcessCluster

LEARNING_ENV_STEPS = 30_000
"""Env steps of a measured training after its first update."""
ROWS = 3
"""Rows of metrics in these; the first, with compilation, does not count."""
EPISODES = 32
MANY_CELLS = 4
"""Kinds of cells from which on one draw of settings is measured, not DRAWS."""
DRAWS = 3


class _Nobody:
    """Hears of a training and does nothing; implements `learner.loop.Observer`."""

    def ready(self) -> None:
        """Ignored."""

    def row(self, row: Row) -> None:
        """Ignored."""

    def checkpoint(self, folder: Location, journal_offset: int) -> None:
        """Ignored."""

    def checkpoint_failed(self, env_steps: int, reason: str) -> None:
        """Ignored."""

    def failed(self, failure: ComponentFailed, decision: Decision) -> None:
        """Ignored."""

    def recovered(self, recovered: Recovered) -> None:
        """Ignored."""


def trial_seconds(search: SearchConfig) -> list[float]:
    """Seconds that a trial takes in one process, measured with a few settings drawn at random from the space."""
    rng = np.random.default_rng(search.sampler_seed)
    kinds = len(search.methods) * len(search.robots) * len(search.groups)
    return [_seconds(search, draw(search.dimensions, rng)) for _ in range(DRAWS if kinds < MANY_CELLS else 1)]


def _seconds(search: SearchConfig, settings: dict[str, Value]) -> float:
    """Seconds of one trial; cells that differ in their seeds take equally long."""
    first = search.seeds[0]
    cells = [cell for cell in search.cells(settings)[1] if cell.config.seed == first or cell.policy != LEARNED]
    times = 1 if search.policy != LEARNED else len(search.seeds)
    return times * sum(map(cell_seconds, cells))


def cell_seconds(cell: Cell) -> float:
    """Seconds that a cell's training and evaluations take in one process."""
    config = cell.config
    if cell.policy != LEARNED:
        return config.final_eval_episodes * episode_seconds(config, Baseline(cell.policy))
    rule = Baseline.GREEDY if exists(Baseline.GREEDY, config.world) else Baseline.RANDOM
    during = config.eval_episodes * (config.total_env_steps // config.eval_every_env_steps)
    episodes = config.final_eval_episodes + during
    return config.total_env_steps / env_steps_per_s(config) + episodes * episode_seconds(config, rule)


def episode_seconds(config: RunConfig, rule: Baseline) -> float:
    """Seconds of one evaluated episode, played by a rule that learns nothing."""
    seeds = list(range(config.final_eval_first_seed, config.final_eval_first_seed + EPISODES))
    evaluate(config.env, rule, seeds[:2])  # compiles
    begin_s = time.perf_counter()
    evaluate(config.env, rule, seeds)
    return (time.perf_counter() - begin_s) / EPISODES


def env_steps_per_s(config: RunConfig) -> float:
    """Env steps a second of a training in one process once it learns, from a short one that leaves nothing behind."""
    total = config.min_replay + LEARNING_ENV_STEPS
    short = dataclasses.replace(
        config,
        total_env_steps=total,
        log_every_env_steps=LEARNING_ENV_STEPS // ROWS,
        eval_every_env_steps=2 * total,
        checkpoint_every_env_steps=2 * total,
    )
    with tempfile.TemporaryDirectory(prefix="shoal-rates-") as folder:
        with closing(Journal(Path(folder) / "rows", 0)) as journal:
            cluster = ProcessCluster(short, 0)
            TrainingLoop(short, cluster, journal, Path(folder) / "checkpoints", _Nobody(), lambda: False).run()
            cluster.close()
            rates = [row.metrics["speed/env_steps_per_s"] for row in journal.rows() if _is_measured(row)]
    return float(np.median(rates[1 - ROWS :]))


def _is_measured(row: Row) -> bool:
    return row.metrics.get("speed/updates_per_s", 0.0) > 0
