"""Which episodes a file embeds, and how recorded episodes are found."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actors.evaluation.trajectory import Episode, save_episodes
from dashboards.pages.report_page import EpisodeGroup
from deploy.report_data.episode_sources import CombinedEpisodes, embedded_episodes
from deploy.report_data.recorded_episodes import RecordedEpisodes
from sim_core.config import WorldConfig
from sim_core.outcomes import Outcome


class MadeUpEpisodes:
    """Episodes of equal size that hold their own key."""

    def __init__(self, *groups: EpisodeGroup) -> None:
        self._groups = list(groups)

    def groups(self) -> list[EpisodeGroup]:
        return self._groups

    def episode(self, key: str, outcome: str, number: int) -> dict[str, Any]:
        return {"is": f"{key}|{outcome}|{number}"}


def group(key: str, played: str = "5r×1g", **counts: int) -> EpisodeGroup:
    return EpisodeGroup(key, "thesis", "learned", "sensor", "5r×1g", "0", played, counts)


FIRST, SECOND = group("a", goal=9, lost=1), group("b", goal=1, captured=5, lost=2)
ELSEWHERE = group("c", played="10r×1g", goal=9)


def test_frequent_outcomes_are_embedded_first_and_extrapolations_are_not():
    source = MadeUpEpisodes(FIRST, SECOND, ELSEWHERE)
    chosen = embedded_episodes(source, source.groups(), each=2, limit_bytes=1e6)
    assert list(chosen) == [
        *("a|goal|0", "b|captured|0", "a|lost|0", "b|lost|0", "b|goal|0"),
        *("a|goal|1", "b|captured|1", "b|lost|1"),
    ]
    assert all(value == {"is": key} for key, value in chosen.items())


def test_the_size_limit_holds():
    source = MadeUpEpisodes(FIRST, SECOND)
    first, second = (len(f'{{"is":"{key}"}}') for key in ("a|goal|0", "b|captured|0"))
    assert list(embedded_episodes(source, source.groups(), 1, first + second)) == ["a|goal|0", "b|captured|0"]
    assert list(embedded_episodes(source, source.groups(), 1, first + second - 1)) == ["a|goal|0"]
    assert embedded_episodes(source, source.groups(), 1, 0) == {}
    assert embedded_episodes(source, source.groups(), 0, 1e6) == {}


def recorded(outcome: Outcome, seed: int) -> Episode:
    return Episode(
        position=np.zeros((3, 10, 2), np.float32),
        velocity=np.zeros((3, 10, 2), np.float32),
        machine=np.zeros((3, 10), np.int8),
        action=np.full(3, -1),
        reward=np.zeros(3, np.float32),
        goal=np.zeros((2, 2), np.float32),
        learner=0,
        outcome=int(outcome),
        seed=seed,
    )


def test_recorded_episodes_are_found_by_outcome(tmp_path: Path):
    episodes = [recorded(outcome, seed) for seed, outcome in enumerate((Outcome.GOAL, Outcome.LOST, Outcome.LOST))]
    save_episodes(tmp_path / "e-episodes.zarr", episodes, WorldConfig(robots=5, groups=2))
    save_episodes(tmp_path / "episode-7.zarr", episodes[:1], WorldConfig(robots=5, groups=2))
    source = CombinedEpisodes(MadeUpEpisodes(FIRST), RecordedEpisodes(tmp_path))
    found = {one.key: one for one in source.groups()}
    assert list(found) == ["a", "episode-7", "e-episodes"]
    assert found["e-episodes"].counts == {"goal": 1, "lost": 2} and found["e-episodes"].played == "5r×2g"
    assert source.episode("e-episodes", "lost", 1)["setup"] == "5r×2g, seed 2"
    assert source.episode("a", "goal", 0) == {"is": "a|goal|0"}
    assert "e-episodes|lost|0" in embedded_episodes(source, source.groups(), 1, 1e6)
    for wrong in (("e-episodes", "lost", 2), ("e-episodes", "captured", 0), ("nothing", "goal", 0)):
        with pytest.raises(LookupError):
            source.episode(*wrong)
