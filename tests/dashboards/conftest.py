"""Recorded episodes to draw: FL-ORCA drives every robot, or the learning robot keeps one heading."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from actors.evaluation.trajectory import Episode
from sim_core.config import WorldConfig
from sim_core.outcomes import Outcome
from sim_core.pilot import Pilot
from sim_core.worlds import WorldBatch
from tests.dashboards.chromium import open_chromium

Recorder = Callable[..., Episode]


def record_episode(config: WorldConfig, seed: int, action: int | None = None) -> Episode:
    """One episode; `action` is the heading that the learning robot keeps, None lets FL-ORCA drive it."""
    worlds = WorldBatch(config, 1)
    worlds.seed([seed])
    worlds.reset()
    states = [_state(worlds)]
    rewards: list[float] = []
    outcome = Outcome.RUNNING
    while outcome == Outcome.RUNNING:
        result = worlds.step(Pilot.FREE if action is None else np.array([action]))
        outcome = Outcome(result.outcome[0])
        states.append(_state(worlds))
        rewards.append(float(result.reward[0]))
    position, velocity, machine = (np.stack(column) for column in zip(*states, strict=True))
    held = -1 if action is None else action
    return Episode(
        position=position,
        velocity=velocity,
        machine=machine,
        action=np.array([held] * len(rewards) + [-1]),
        reward=np.array([*rewards, 0.0], np.float32),
        goal=worlds.goals()[0],
        learner=int(worlds.state.learner[0]),
        outcome=int(outcome),
        seed=seed,
    )


def _state(worlds: WorldBatch) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    velocity = np.stack([worlds.state.vel_x[0], worlds.state.vel_y[0]], axis=-1)
    return worlds.positions()[0], velocity, worlds.state.machine[0].copy()


@pytest.fixture(scope="session")
def record() -> Recorder:
    return record_episode


@pytest.fixture(scope="session")
def config() -> WorldConfig:
    return WorldConfig(robots=5, groups=2)


@pytest.fixture(scope="session")
def episode(config: WorldConfig) -> Episode:
    """An episode that FL-ORCA drives to its end."""
    return record_episode(config, seed=3)


@pytest.fixture(scope="session")
def failed(config: WorldConfig) -> Episode:
    """An episode in which the learning robot leaves its group."""
    return record_episode(config, seed=3, action=0)


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with open_chromium(tmp_path_factory.mktemp("chromium")) as chromium:
        yield chromium
