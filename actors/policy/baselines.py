"""Ways to drive the learning robot that need no learning: what learned policies are measured against.

`fl-orca` drives it as every other robot of the swarm, knowing its goal and its neighbours' velocities, of which the
learner's observation holds less or nothing. `greedy` heads for where the observation shows the own group. `random`
draws actions.
"""

from __future__ import annotations

import enum
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sim_core.config import WorldConfig
from sim_core.methods.headings import heading_velocities


class Player(Protocol):
    """Chooses the actions of a batch of episodes that were started together, one call an env step."""

    def act(self, observation: NDArray[Any]) -> NDArray[np.int64] | None:
        """Actions `[batch]` for observations `[batch, *shape]`; None lets FL-ORCA drive the learning robots."""
        ...


class Baseline(enum.StrEnum):
    """The baselines by the names that the command line knows."""

    FL_ORCA = "fl-orca"
    GREEDY = "greedy"
    RANDOM = "random"


class FlOrcaPlayer:
    """FL-ORCA itself, which obeys no action: one speed less heading, and waits where it must."""

    def act(self, observation: NDArray[Any]) -> None:
        """None; see Player."""


class GreedySensorPlayer:
    """M_sensor: heads into the sector with the most own robots less other robots, over both sensing regions.

    Among equal sectors, the one with the most in the outer ring: its robots are those that are about to be lost.
    Among these, the lowest index, as a learned policy does.

    Args:
      config: the setup.
    """

    def __init__(self, config: WorldConfig) -> None:
        self._cells = 2 * config.sectors
        self._separate = config.sensor_counts == "separate"

    def act(self, observation: NDArray[Any]) -> NDArray[np.int64]:
        """Actions `[batch]` for counts `[batch, 2q]`, or `[batch, 4q]` where they are apart."""
        counts = observation.astype(np.int64)
        own, others = counts[:, : self._cells], counts[:, self._cells :]
        inner, ring = np.split(own - others if self._separate else own, 2, axis=1)
        size = 2 * np.abs(ring).max(initial=0) + 1  # more than two rings can differ by
        return np.asarray(np.argmax(size * (inner + ring) + ring, axis=1), np.int64)


class GreedyEllipsePlayer:
    """M_IN and M_OUT: the heading nearest to the direction of the own group's centre; the lowest index among equals.

    Args:
      config: the setup.
    """

    def __init__(self, config: WorldConfig) -> None:
        self._headings = heading_velocities(config, np.float64)[: config.sectors]

    def act(self, observation: NDArray[Any]) -> NDArray[np.int64]:
        """Actions `[batch]` for state matrices `[batch, groups * columns]`, the own group's row first."""
        centre = observation[:, 2:4].astype(np.float64)
        return np.asarray(np.argmax(centre @ self._headings.T, axis=1), np.int64)


class RandomPlayer:
    """Uniform actions, of a stream of each episode's own: they do not depend on which episodes play together.

    The stream is a child of the episode's seed; the world's is that of the seed itself.

    Args:
      config: the setup.
      seeds: seed of every episode.
    """

    def __init__(self, config: WorldConfig, seeds: list[int]) -> None:
        streams = [np.random.default_rng(np.random.SeedSequence(seed).spawn(1)[0]) for seed in seeds]
        draws = [stream.integers(config.num_actions, size=config.horizon_steps) for stream in streams]
        self._actions = iter(np.stack(draws, axis=1))  # [horizon_steps, batch]

    def act(self, observation: NDArray[Any]) -> NDArray[np.int64]:
        """Actions `[batch]` of the next env step."""
        return next(self._actions)


def make_baseline(baseline: Baseline, config: WorldConfig, seeds: list[int]) -> Player:
    """The player of a baseline in our own environment, for one episode a seed."""
    if baseline is Baseline.FL_ORCA:
        return FlOrcaPlayer()
    if baseline is Baseline.RANDOM:
        return RandomPlayer(config, seeds)
    return GreedySensorPlayer(config) if config.method == "sensor" else GreedyEllipsePlayer(config)
