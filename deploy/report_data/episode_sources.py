"""Where a report's episodes come from, and which of them a file embeds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Protocol, TypeVar

from dashboards.pages.assets import to_json
from dashboards.pages.report_page import EpisodeGroup
from sim_core.outcomes import ENDED

UNKNOWN = "–"
T = TypeVar("T")


class EpisodeSource(Protocol):
    """Episodes, found by group, outcome and number."""

    def groups(self) -> list[EpisodeGroup]:
        """The groups that exist now."""
        ...

    def episode(self, key: str, outcome: str, number: int) -> dict[str, Any]:
        """One episode for the player, as from `dashboards.pages.player.player_data`.

        Args:
          key: of the group, as of the last call of `groups`.
          outcome: the outcome's name.
          number: among the group's episodes with this outcome, from 0.

        Raises:
          LookupError: there is no such episode.
          ConfigError, ValueError: it exists but cannot be read or played.
        """
        ...


class CombinedEpisodes:
    """Several sources as one.

    Args:
      sources: in the order of their groups; no two have a group of the same key.
    """

    def __init__(self, *sources: EpisodeSource) -> None:
        self._sources = sources
        self._owner: dict[str, EpisodeSource] = {}

    def groups(self) -> list[EpisodeGroup]:
        """The groups of all sources."""
        found = [(source, group) for source in self._sources for group in source.groups()]
        self._owner = {group.key: source for source, group in found}
        return [group for _, group in found]

    def episode(self, key: str, outcome: str, number: int) -> dict[str, Any]:
        """The episode of the source that has the group."""
        return lookup(self._owner, key).episode(key, outcome, number)


def lookup(by_key: dict[str, T], key: str) -> T:
    """The value of a group's key; raises LookupError if there is none."""
    if key not in by_key:
        raise LookupError(f"group {key!r}")
    return by_key[key]


def nth(values: Sequence[T], number: int) -> T:
    """The value with this number, from 0; raises LookupError if there is none."""
    if not 0 <= number < len(values):
        raise LookupError(f"episode {number}")
    return values[number]


def embedded_episodes(
    source: EpisodeSource, groups: Sequence[EpisodeGroup], each: int, limit_bytes: float
) -> dict[str, dict[str, Any]]:
    """Chooses the episodes that a file embeds.

    First come one episode of every group's most frequent outcome, then of its second, and so on, so that the limit cuts
    off rare outcomes. Groups of Extrapolation are left out, because there are many.

    Args:
      source: where the episodes come from.
      groups: the groups to choose from.
      each: episodes of each group and outcome.
      limit_bytes: size of all episodes as JSON.

    Returns:
      The episodes by `GROUP|outcome|number`.
    """
    chosen: dict[str, dict[str, Any]] = {}
    size = 0
    for key, outcome, number in _by_frequency(groups, each):
        episode = source.episode(key, outcome, number)
        size += len(to_json(episode))
        if size > limit_bytes:
            break
        chosen[f"{key}|{outcome}|{number}"] = episode
    return chosen


def _by_frequency(groups: Sequence[EpisodeGroup], each: int) -> Iterator[tuple[str, str, int]]:
    """Group key, outcome and number of the episodes to embed, most frequent outcomes first."""
    fixed = [group for group in groups if group.trained in (group.played, UNKNOWN)]
    ranked = {group.key: sorted(group.counts, key=lambda name: -group.counts[name]) for group in fixed}
    for number in range(each):
        for rank in range(len(ENDED)):
            for group in fixed:
                outcome = ranked[group.key][rank] if rank < len(ranked[group.key]) else None
                if outcome is not None and number < group.counts[outcome]:
                    yield group.key, outcome, number
