"""How much a rollout worker explores: one schedule for all, or a ladder over workers.

Every rate is a function of counters that a checkpoint holds, so that a resumed run goes on where it was.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

GREEDY = -1
"""In the place of an action: the policy's own."""


class Exploration(NamedTuple):
    """Settings of epsilon-greedy exploration (see RunConfig for their meaning)."""

    kind: Literal["schedule", "ladder"]
    start: float
    end: float
    decay_env_steps: int
    ladder_base: float
    ladder_exponent: float


def epsilon(exploration: Exploration, env_steps: int, worker_id: int, workers: int) -> float:
    """The worker's exploration rate after `env_steps` env steps of the whole run.

    The ladder is Ape-X's (Horgan et al. 2018, Section 4.1): epsilon_i = base^(1 + i / (N - 1) * exponent).
    """
    if exploration.kind == "ladder":
        rung = worker_id / (workers - 1) if workers > 1 else 0.0
        return float(exploration.ladder_base ** (1 + rung * exploration.ladder_exponent))
    done = min(1.0, env_steps / exploration.decay_env_steps)
    return exploration.start + done * (exploration.end - exploration.start)


def draw_detours(shape: tuple[int, ...], rate: float, num_actions: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """What epsilon-greedy does of its own accord, for many steps at once.

    Returns:
      A uniform action with probability `rate`, else GREEDY; of `shape`.
    """
    random = rng.integers(num_actions, size=shape)
    return np.where(rng.random(shape) < rate, random, GREEDY)


def explore(greedy: NDArray[np.int64], detours: NDArray[np.int64]) -> NDArray[np.int64]:
    """`greedy` `[batch]`, with the actions of `detours` `[batch]` in the place of some."""
    return np.where(detours == GREEDY, greedy, detours)
