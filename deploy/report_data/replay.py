"""Plays an evaluated episode of a sweep's cell again, from its stored seed."""

from __future__ import annotations

from typing import Any

import numpy as np

from actors.evaluation.evaluation_store import load_evaluation
from actors.evaluation.evaluator import Candidate, record_episode
from actors.evaluation.result_table import LEARNED, ResultRow
from actors.policy.baselines import Baseline
from dashboards.pages.player import player_data
from deploy.report_data.episode_sources import nth
from deploy.runs.policy_lookup import find_policy
from learner.file_names import EVALUATIONS
from learner.run_folder import RunFolder
from sim_core.outcomes import OUTCOME_NAMES


def replay(folder: RunFolder, row: ResultRow, outcome: str, number: int) -> dict[str, Any]:
    """One episode for the player.

    Args:
      folder: the cell's folder.
      row: the row of results that counts the episode.
      outcome: the outcome's name.
      number: among the row's episodes with this outcome, from 0.

    Raises:
      LookupError: there is no such episode.
      ConfigError: the stored evaluation or the policy cannot be read.
    """
    if outcome not in OUTCOME_NAMES:
        raise LookupError(f"outcome {outcome!r}")
    stored = load_evaluation(folder.path / EVALUATIONS / f"{row.robots}r{row.groups}g.zarr")
    entries = np.flatnonzero(stored.stats.outcome == OUTCOME_NAMES.index(outcome)).tolist()
    entry, learners = nth(entries, number), stored.spec.world.num_learners
    episode = record_episode(stored.spec, _candidate(folder, row), int(stored.seed[entry]), entry % learners)
    return player_data(episode, stored.spec.world)


def _candidate(folder: RunFolder, row: ResultRow) -> Candidate:
    return find_policy(folder, folder.config()) if row.policy == LEARNED else Baseline(row.policy)
