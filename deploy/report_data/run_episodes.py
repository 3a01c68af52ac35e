"""Episodes of a run's newest policy."""

from __future__ import annotations

from typing import Any

import numpy as np

from actors.evaluation.evaluator import evaluate, record_episode
from actors.policy.policy import WeightsSnapshot
from dashboards.pages.player import player_data
from dashboards.pages.report_page import EpisodeGroup
from deploy.report_data.episode_sources import nth
from deploy.runs.policy_lookup import NewestPolicy
from learner.run_folder import RunFolder
from sim_core.checks import ConfigError
from sim_core.outcomes import ENDED

EPISODES = 100
"""Episodes that the policy plays, so that there are some of every outcome to choose from."""
KEY = "newest"


class RunEpisodes:
    """Episodes of a run's newest policy, in our own environment.

    Args:
      folder: the run.
    """

    def __init__(self, folder: RunFolder) -> None:
        self._config = folder.config()
        self._spec = self._config.env.of_setup(self._config.world)  # of several setups, the run's own
        self._policy = NewestPolicy(folder, self._config)
        self._weights: WeightsSnapshot | None = None
        self._entries: dict[str, list[int]] = {}

    def groups(self) -> list[EpisodeGroup]:
        """One group, or none while the run has no policy."""
        try:
            weights = self._policy.get()
        except ConfigError:
            return []
        if weights is not self._weights:
            self._weights, self._entries = weights, self._play(weights)
        world, counts = self._config.world, {name: len(entries) for name, entries in self._entries.items()}
        policy, seed = f"of update {weights.version:,}", str(self._config.seed)
        return [EpisodeGroup(KEY, "", policy, world.method_name, world.setup, seed, world.setup, counts)]

    def _play(self, weights: WeightsSnapshot) -> dict[str, list[int]]:
        """Plays the episodes; their places in the evaluation by outcome."""
        first = self._config.final_eval_first_seed
        outcomes = evaluate(self._spec, weights, list(range(first, first + EPISODES))).outcome
        return {outcome.name.lower(): np.flatnonzero(outcomes == outcome).tolist() for outcome in ENDED}

    def episode(self, key: str, outcome: str, number: int) -> dict[str, Any]:
        """Plays the episode."""
        if key != KEY or self._weights is None:
            raise LookupError(f"group {key!r}")
        seed, learner = divmod(nth(self._entries.get(outcome, []), number), self._spec.world.num_learners)
        seed += self._config.final_eval_first_seed
        return player_data(record_episode(self._spec, self._weights, seed, learner), self._config.world)
