"""Episodes that `shoal watch` and `shoal evaluate --record` have written."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from dashboards.pages.player import player_data
from dashboards.pages.report_page import EpisodeGroup
from deploy.report_data.episode_sources import UNKNOWN, lookup, nth
from sim_core.config import WorldConfig
from sim_core.outcomes import OUTCOME_NAMES

if TYPE_CHECKING:
    from actors.evaluation.trajectory import Episode


class RecordedEpisodes:
    """Episodes in zarr stores.

    Args:
      folders: folders with stores named `episode*.zarr` or `*-episodes.zarr`.
    """

    def __init__(self, *folders: Path) -> None:
        self._folders = folders
        self._stores: dict[str, tuple[list[Episode], WorldConfig]] = {}

    def groups(self) -> list[EpisodeGroup]:
        """One group per store."""
        paths = [path for folder in self._folders for path in sorted(folder.glob("episode*.zarr"))]
        paths += [path for folder in self._folders for path in sorted(folder.glob("*-episodes.zarr"))]
        self._stores = {path.stem: _load(path) for path in paths}
        return [_group(name, episodes, world) for name, (episodes, world) in self._stores.items()]

    def episode(self, key: str, outcome: str, number: int) -> dict[str, Any]:
        """Reads the episode."""
        episodes, world = lookup(self._stores, key)
        found = [episode for episode in episodes if OUTCOME_NAMES[episode.outcome] == outcome]
        return player_data(nth(found, number), world)


def _load(store: Path) -> tuple[list[Episode], WorldConfig]:
    from actors.evaluation.trajectory import load_episodes  # imports zarr

    return load_episodes(store)


def _group(name: str, episodes: list[Episode], world: WorldConfig) -> EpisodeGroup:
    outcomes = [OUTCOME_NAMES[episode.outcome] for episode in episodes]
    counts = {outcome: outcomes.count(outcome) for outcome in dict.fromkeys(outcomes)}
    return EpisodeGroup(name, "", f"recorded: {name}", world.method_name, UNKNOWN, UNKNOWN, world.setup, counts)
