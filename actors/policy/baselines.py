"""Rules that drive the learning robot and learn nothing: what learned policies are measured against.

`fl-orca` drives it as every other robot of the swarm: it knows its goal and its neighbours' velocities, which the
learning robot's observation does not hold. `greedy` is the method's own rule. `random` draws actions.
"""

from __future__ import annotations

import enum
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sim_core.checks import ConfigError
from sim_core.config import WorldConfig


class ActionRule(Protocol):
    """Chooses the actions of a batch of episodes that were started together, one call an env step."""

    def act(self, observation: NDArray[Any]) -> NDArray[np.int64] | None:
        """Actions `[batch]` for observations `[batch, *shape]`; None lets FL-ORCA drive the learning robots."""
        ...


class Baseline(enum.StrEnum):
    """The baselines by the names that the command line knows."""

    FL_ORCA = "fl-orca"
    GREEDY = "greedy"
    RANDOM = "random"


class FlOrcaRule:
    """FL-ORCA itself, which obeys no action: one speed less heading, and waits where it must."""

    def act(self, observation: NDArray[Any]) -> None:
        """None; see ActionRule."""


class GreedyMethodRule:
    """The greedy rule of the world's method (`sim_core.methods.base.Method.greedy`).

    Args:
      config: the setup.

    Raises:
      ConfigError: the method has none.
    """

    def __init__(self, config: WorldConfig) -> None:
        rule = config.method_class.greedy(config)
        if rule is None:
            raise ConfigError(f"method {config.method_name} has no greedy rule; play fl-orca or random")
        self._rule = rule

    def act(self, observation: NDArray[Any]) -> NDArray[np.int64]:
        """Actions `[batch]` for observations `[batch, *shape]`."""
        return self._rule(observation)


class RandomRule:
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


def make_baseline(baseline: Baseline, config: WorldConfig, seeds: list[int]) -> ActionRule:
    """The action rule of a baseline in our own environment, for one episode a seed.

    Raises:
      ConfigError: the method has no such rule.
    """
    if baseline is Baseline.FL_ORCA:
        return FlOrcaRule()
    return RandomRule(config, seeds) if baseline is Baseline.RANDOM else GreedyMethodRule(config)
