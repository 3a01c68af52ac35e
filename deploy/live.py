"""`shoal watch --live`: a page on 127.0.0.1 that plays what a running training has learned so far."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rich.console import Console

from actors.evaluation.evaluator import record_episode
from dashboards.pages.assets import SERVED
from dashboards.pages.player import player_data, player_page
from dashboards.pages.server import PageServer
from deploy.runs.policy_lookup import NewestPolicy
from learner.config import RunConfig
from learner.run_folder import RunFolder
from learner.tracking.journal import read_rows
from sim_core.checks import ConfigError, require

if TYPE_CHECKING:
    from deploy.options.results import Watch


class LiveRun:
    """What the page asks for.

    Args:
      folder: the run.
      config: its config, of our own environment.
      first_seed: seed of the first episode; the others count on.
    """

    def __init__(self, folder: RunFolder, config: RunConfig, first_seed: int) -> None:
        self._folder = folder
        self._config = config
        self._first_seed = first_seed
        self._policy = NewestPolicy(folder, config)

    def page(self, query: Mapping[str, str]) -> str:
        """The player."""
        title = f"{self._folder.path.name}: {self._config.name}, live"
        return player_page(title, {}, "live.js", SERVED)

    def episode(self, query: Mapping[str, str]) -> dict[str, Any]:
        """Episode `number` of the newest policy.

        Raises:
          ConfigError: there is no policy yet.
          LookupError: the number is none.
        """
        number = episode_number(query)
        try:
            weights = self._policy.get()
        except ConfigError as error:
            raise ConfigError("The run has no checkpoint yet; the first one plays as soon as it is there.") from error
        episode = record_episode(self._config.env, weights, (self._first_seed + number) % 2**32)
        return {**player_data(episode, self._config.world), "updates": weights.version}

    def status(self, query: Mapping[str, str]) -> dict[str, Any]:
        """How far the training is."""
        rows = read_rows(self._folder.journal)
        return {
            "env_steps": max((row.env_steps for row in rows), default=0),
            "total_env_steps": self._config.total_env_steps,
            "updates": self._policy.get().version,
        }


def episode_number(query: Mapping[str, str]) -> int:
    """The number that a page asks for; raises LookupError if it is none."""
    text = query.get("number", "")
    if not text.isdecimal():
        raise LookupError(f"episode {text!r}")
    return int(text)


def live_server(folder: RunFolder, config: RunConfig, first_seed: int, port: int) -> PageServer:
    """The server of a run's live page.

    Raises:
      ConfigError: the run is of another environment than ours, or the port is taken.
    """
    require(config.env.is_swarm, f"--live plays our own environment only, not {config.env_id}")
    run = LiveRun(folder, config, first_seed)
    return PageServer({"/": run.page, "/episode.json": run.episode, "/status.json": run.status}, port)


def watch_live(folder: RunFolder, config: RunConfig, command: Watch) -> int:
    """Serves the page until it is interrupted; returns the exit code."""
    return serve_until_interrupted(live_server(folder, config, command.seed, command.port))


def serve_until_interrupted(server: PageServer) -> int:
    """Says where the page is and serves it; Ctrl-C is how it ends, and no failure."""
    Console().print(f"{server.url}  (Ctrl-C ends it)", highlight=False, soft_wrap=True)
    try:
        server.serve()
    except KeyboardInterrupt:
        Console().print("ended", highlight=False)
    return 0
