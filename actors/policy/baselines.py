"""Rules that drive the learning robot and learn nothing: what learned policies are measured against.

`fl-orca` drives it as every other robot of the swarm: it knows its goal and its neighbours' velocities, which the
learning robot's observation does not hold. `fl-orca-snapped` takes the nearest action to that, once a decision.
`greedy` and `field` are the method's own rules, on its observation. `random` draws actions.
"""

from __future__ import annotations

import enum
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sim_core.checks import require
from sim_core.config import WorldConfig
from sim_core.pilot import Pilot


class ActionRule(Protocol):
    """Chooses the actions of a batch of episodes that were started together, one call a decision."""

    def act(self, observation: NDArray[Any]) -> NDArray[np.int64] | Pilot:
        """Actions `[batch]` for observations `[batch, *shape]`, or how FL-ORCA drives the learning robots."""
        ...


class Baseline(enum.StrEnum):
    """The baselines by the names that the command line knows."""

    FL_ORCA = "fl-orca"
    FL_ORCA_SNAPPED = "fl-orca-snapped"
    GREEDY = "greedy"
    FIELD = "field"
    RANDOM = "random"


PILOTS = {Baseline.FL_ORCA: Pilot.FREE, Baseline.FL_ORCA_SNAPPED: Pilot.SNAPPED}
METHOD_RULES = (Baseline.GREEDY, Baseline.FIELD)


def exists(baseline: Baseline, config: WorldConfig) -> bool:
    """Whether the world's method has this baseline."""
    return baseline not in METHOD_RULES or baseline in config.method_class.rules(config)


def check_exists(baseline: Baseline, config: WorldConfig) -> None:
    """Raises ConfigError if the world's method lacks this baseline."""
    others = ", ".join(other for other in Baseline if exists(other, config))
    require(exists(baseline, config), f"method {config.method_name} has no rule {baseline}; play one of: {others}")


class FlOrcaRule:
    """FL-ORCA itself, free or snapped to the actions.

    Args:
      pilot: which of the two.
    """

    def __init__(self, pilot: Pilot) -> None:
        self._pilot = pilot

    def act(self, observation: NDArray[Any]) -> Pilot:
        """The pilot; see ActionRule."""
        return self._pilot


class MethodRule:
    """A rule of the world's method (`sim_core.methods.base.Method.rules`).

    Args:
      config: the setup.
      baseline: which.

    Raises:
      ConfigError: the method has none of this name.
    """

    def __init__(self, config: WorldConfig, baseline: Baseline) -> None:
        check_exists(baseline, config)
        self._rule = config.method_class.rules(config)[baseline]
        self._history, self._row_size = config.history, config.method_class.row_size

    def act(self, observation: NDArray[Any]) -> NDArray[np.int64]:
        """Actions `[batch]` for observations `[batch, *shape]`; of a history the rule sees the newest."""
        if self._history > 1:
            width = self._row_size or observation.shape[1] // self._history
            rows = observation.reshape(len(observation), -1, self._history * width)
            observation = rows[:, :, :width].reshape(len(observation), -1)
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
        shape = config.num_learners, config.horizon_steps
        draws = [stream.integers(config.num_actions, size=shape) for stream in streams]
        self._actions = iter(np.concatenate(draws).T)  # [horizon_steps, batch]

    def act(self, observation: NDArray[Any]) -> NDArray[np.int64]:
        """Actions `[batch]` of the next env step."""
        return next(self._actions)


def make_baseline(baseline: Baseline, config: WorldConfig, seeds: list[int]) -> ActionRule:
    """The action rule of a baseline in our own environment, for one episode a seed.

    Raises:
      ConfigError: the method has no such rule.
    """
    if baseline in PILOTS:
        return FlOrcaRule(PILOTS[baseline])
    return RandomRule(config, seeds) if baseline is Baseline.RANDOM else MethodRule(config, baseline)
