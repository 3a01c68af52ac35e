"""The page of `shoal watch --live`: plays the newest policy of a running training, one episode after the other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from actors.evaluation.evaluator import record_episode
from dashboards.pages.assets import SERVED
from dashboards.pages.player import player_data, player_page
from dashboards.pages.server import PageServer, episode_number
from deploy.runs.policy_lookup import NewestPolicy
from learner.config import RunConfig
from learner.run_folder import RunFolder
from learner.tracking.journal import read_rows
from sim_core.checks import ConfigError, require


class LiveRun:
    """The answers to the page's requests.

    Args:
      folder: the run.
      config: its config, of our own environment.
      first_seed: seed of episode 0; episode n has seed `first_seed + n`, modulo 2^32.
    """

    def __init__(self, folder: RunFolder, config: RunConfig, first_seed: int) -> None:
        self._folder = folder
        self._config = config
        self._first_seed = first_seed
        self._policy = NewestPolicy(folder, config)

    def page(self, query: Mapping[str, str]) -> str:
        """The page with the player."""
        title = f"{self._folder.path.name}: {self._config.name}, live"
        return player_page(title, {}, ["request.js", "live.js"], SERVED)

    def episode(self, query: Mapping[str, str]) -> dict[str, Any]:
        """Episode `number` of the newest policy, and after how many updates that policy was published.

        Raises:
          ConfigError: there is no policy yet.
          LookupError: the query has no valid number.
        """
        number = episode_number(query)
        try:
            weights = self._policy.get()
        except ConfigError as error:
            raise ConfigError("The run has no checkpoint yet; its first one is played as soon as it exists.") from error
        episode = record_episode(self._config.env, weights, (self._first_seed + number) % 2**32)
        return {**player_data(episode, self._config.world), "updates": weights.version}

    def status(self, query: Mapping[str, str]) -> dict[str, Any]:
        """Env steps trained, env steps in total, and updates of the newest policy."""
        rows = read_rows(self._folder.journal)
        return {
            "env_steps": max((row.env_steps for row in rows), default=0),
            "total_env_steps": self._config.total_env_steps,
            "updates": self._policy.get().version,
        }


def live_server(folder: RunFolder, config: RunConfig, first_seed: int, port: int) -> PageServer:
    """The server of a run's live page.

    Raises:
      ConfigError: the run's environment is not ours, or the port is taken.
    """
    require(config.env.is_swarm, f"--live plays our own environment only, not {config.env_id}")
    run = LiveRun(folder, config, first_seed)
    return PageServer({"/": run.page, "/episode.json": run.episode, "/status.json": run.status}, port)
