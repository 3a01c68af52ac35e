"""Epsilon-greedy exploration: one schedule for all rollout workers, or Ape-X's ladder of constant rates.

Every rate is a function of counters that a checkpoint holds, so that a resumed run continues with the same rates.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

GREEDY = -1
"""Stands for the policy's greedy action among random actions."""


class Exploration(NamedTuple):
    """Settings of epsilon-greedy exploration (see RunConfig)."""

    kind: Literal["schedule", "ladder"]
    start: float
    end: float
    decay_env_steps: int
    ladder_base: float
    ladder_exponent: float


def linear_schedule(start: float, end: float, decay_env_steps: int, env_steps: int) -> float:
    """Value after `env_steps` env steps: linear from `start` to `end` over `decay_env_steps`, then constant."""
    return start + min(1.0, env_steps / decay_env_steps) * (end - start)


def epsilon(exploration: Exploration, env_steps: int, worker_id: int, workers: int) -> float:
    """Exploration rate of worker `worker_id` of `workers` after `env_steps` env steps of the whole run.

    The schedule is linear and then constant. The ladder is that of Ape-X (Horgan et al. 2018, Section 4.1):
    epsilon_i = base^(1 + i / (N - 1) * exponent).
    """
    if exploration.kind == "ladder":
        rung = worker_id / (workers - 1) if workers > 1 else 0.0
        return float(exploration.ladder_base ** (1 + rung * exploration.ladder_exponent))
    return linear_schedule(exploration.start, exploration.end, exploration.decay_env_steps, env_steps)


def draw_random_actions(
    shape: tuple[int, ...], rate: float, num_actions: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Draws the random actions of many steps in advance.

    Args:
      shape: shape of the result.
      rate: exploration rate, the probability of a random action.
      num_actions: number of actions.
      rng: random stream.

    Returns:
      `shape` int64: a uniformly drawn action with probability `rate`, GREEDY elsewhere.
    """
    random = rng.integers(num_actions, size=shape)
    return np.where(rng.random(shape) < rate, random, GREEDY)
