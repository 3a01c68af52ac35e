"""What travels from a rollout worker to a replay shard, and what comes back: one named tuple a hop."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

SCHEMA_VERSION = 1
"""Version of the block layout; a shard refuses any other."""

NO_OUTCOME = -1
"""Outcome of an episode of an environment that names none."""


class EpisodeStats(NamedTuple):
    """Episodes that ended while a block was collected; one entry an episode."""

    outcome: NDArray[np.int8]
    length_steps: NDArray[np.int32]
    episode_return: NDArray[np.float64]


class BlockHeader(NamedTuple):
    """Where a block comes from.

    `incarnation` counts the starts of worker `worker_id`, `sequence` its blocks. `policy_version` is the
    number of updates behind the weights that acted, `policy_time_s` the wall time of their publication.
    """

    schema_version: int
    worker_id: int
    incarnation: int
    sequence: int
    policy_version: int
    policy_time_s: float
    epsilon: float
    env_steps: int


class TransitionBlock(NamedTuple):
    """Transitions of a worker, one packed row each (see `transition_dtype`)."""

    header: BlockHeader
    rows: NDArray[Any]
    episodes: EpisodeStats


class AddReply(NamedTuple):
    """A shard's answer to a push: what was stored, and newer weights if there are any.

    `weights` is a reference to a WeightsSnapshot, None if the block came from the newest version.
    """

    stored: int
    duplicate: bool
    weights_version: int
    weights: Any


class BlockReport(NamedTuple):
    """What the training loop learns of a stored block; no transitions."""

    header: BlockHeader
    episodes: EpisodeStats
    stored: int
    staleness_updates: int
    staleness_s: float


class Draws(NamedTuple):
    """How rows of a prioritised shard were drawn.

    `number` `[count]` tells a row apart from the one that may take its place (it is the how manieth that the shard
    stored), `probability` `[count]` is with which the shard drew it.
    """

    number: NDArray[np.int64]
    probability: NDArray[np.float64]


class SampleReply(NamedTuple):
    """Rows drawn from a shard `[count]`, and what the shard counts among all (see ReplayShard.mass).

    `draws` tells how they were drawn, None where all rows are drawn alike.
    """

    rows: NDArray[Any]
    mass: float
    draws: Draws | None


def transition_dtype(observation_space: gym.spaces.Box) -> np.dtype[Any]:
    """Packed row of one transition: (s_t, a_t, n-step reward, discount_t, s_{t+n}).

    `discount` is what the value of `next_observation` counts: gamma^n, and 0 where the task ended. A
    timeout keeps its discount: it is no terminal state.
    """
    observation: Any = (observation_space.dtype, observation_space.shape)
    return np.dtype(
        [
            ("reward", np.float32),
            ("discount", np.float32),
            ("action", np.int32),
            ("observation", *observation),
            ("next_observation", *observation),
        ],
        align=True,
    )
