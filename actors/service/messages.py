"""What travels from a rollout worker to a replay shard, and what comes back: one named tuple a hop."""

from __future__ import annotations

from enum import StrEnum
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from actors.service.fault_policy import Fault
from actors.service.packing import Packed

SCHEMA_VERSION = 3
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
    number of updates behind the weights that acted, `policy_time_s` the wall time of their publication. `made`
    counts the transitions of this incarnation, this block's included.
    """

    schema_version: int
    worker_id: int
    incarnation: int
    sequence: int
    policy_version: int
    policy_time_s: float
    epsilon: float
    env_steps: int
    made: int = 0


class TransitionBlock(NamedTuple):
    """Transitions of a worker (see `actors.service.packing.Packed`)."""

    header: BlockHeader
    packed: Packed
    episodes: EpisodeStats

    @property
    def transitions(self) -> int:
        """How many there are."""
        return len(self.packed.rows)


class AddReply(NamedTuple):
    """A shard's answer to a push: what was stored, and newer weights if there are any.

    `weights` is a WeightsSnapshot, None if the block came from the newest version. A `duplicate` is
    refused; it is `outdated` if it was never stored, for its worker has been replaced or a later block overtook it.
    """

    stored: int
    duplicate: bool
    weights_version: int
    weights: Any
    outdated: bool = False


class Dropped(StrEnum):
    """Why a transition that was made is not stored."""

    DUPLICATE = "duplicate"
    """It is stored already."""
    OUTDATED = "outdated"
    """A later block overtook it."""
    SHARD_LOST = "shard lost"
    """The shard that it was sent to is gone."""
    WORKER_LOST = "worker lost"
    """Its worker went before it was pushed."""


ACTS, STORES, WAITS = "acts", "stores", "waits"
"""A rollout worker steps its environments, waits for a shard's reply to a push, waits for the training loop."""


class BlockReport(NamedTuple):
    """What the training loop learns of a block; no transitions.

    `shard` and its incarnation say where it was pushed, `rows` how many transitions it holds; with a reason in
    `dropped` none of them is stored, because of `fault` if the shard failed. `seconds` says where the worker's time
    went since its last report (see ACTS, STORES, WAITS).
    """

    header: BlockHeader
    episodes: EpisodeStats
    stored: int
    staleness_updates: int
    staleness_s: float
    rows: int = 0
    shard: int = 0
    shard_incarnation: int = 0
    dropped: Dropped | None = None
    fault: Fault | None = None
    seconds: dict[str, float] = {}  # never changed


class Delivered(NamedTuple):
    """What a shard has stored of one incarnation of a worker; `made` is the highest count in its headers."""

    rows: int = 0
    env_steps: int = 0
    episodes: int = 0
    made: int = 0


class Draws(NamedTuple):
    """How rows of a prioritised shard were drawn.

    `number` `[count]` tells a row apart from the one that may take its place (it is the how manieth that the shard
    stored), `probability` `[count]` is with which the shard drew it.
    """

    number: NDArray[np.int64]
    probability: NDArray[np.float64]


class SampleReply(NamedTuple):
    """Transitions drawn from a shard, and what the shard counts among all (see ReplayShard.mass).

    `columns` are theirs, `[count, ...]` each, by the names of `transition_dtype`; `draws` tells how they were drawn,
    None where all are drawn alike.
    """

    columns: dict[str, NDArray[Any]]
    mass: float
    draws: Draws | None


def transition_dtype(observation_space: gym.spaces.Box) -> np.dtype[Any]:
    """Row of one whole transition: (s_t, a_t, n-step reward, discount_t, s_{t+n}).

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
