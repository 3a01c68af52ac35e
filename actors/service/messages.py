"""Messages between rollout workers, replay shards, the learner and the training loop: one named tuple per hop."""

from __future__ import annotations

from enum import StrEnum
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from actors.policy.policy import WeightsSnapshot
from actors.service.fault_policy import Fault
from actors.service.packing import Packed

SCHEMA_VERSION = 3
"""Version of the block layout; a shard refuses any other."""

NO_OUTCOME = -1
"""Outcome of an episode whose environment reports none."""


TEAM_DTYPE = np.dtype([("learners", np.int32), ("segregation", np.float32), ("hit_learner", np.bool_)])
"""What an evaluation knows of a learning robot's world: how many robots of it learn, the mean share of the pairs of
groups that were segregated (Eq. 3.1), and whether this robot's episode ended in a collision with one that learns."""
NO_TEAM = np.zeros(0, TEAM_DTYPE)

VALUE_DTYPE = np.dtype(
    [(name, np.float64) for name in ("q_start", "return_start", "q_visited", "return_visited")],
)
"""What a policy expects of one greedy episode, beside what it gets, in units of reward: the value of the first action,
and the discounted return that follows; means over all states of the values of the actions taken there, and of the
discounted returns that follow (van Hasselt et al. 2016, Section 4). What would come after a cut is not counted."""
NO_VALUES = np.zeros(0, VALUE_DTYPE)


class EpisodeStats(NamedTuple):
    """Statistics of finished episodes `[episodes]`: outcome, length, and undiscounted return.

    The length counts simulator steps in the swarm environment, env steps in others. Where several robots of a world
    learn, each has an episode, and those of a world stand together; `team` `[episodes]` TEAM_DTYPE tells of their world
    in an evaluation, and is empty otherwise. `values` `[episodes]` VALUE_DTYPE tells what a policy expected, if an
    evaluation was asked for it, and is empty otherwise.
    """

    outcome: NDArray[np.int8]
    length_steps: NDArray[np.int32]
    episode_return: NDArray[np.float64]
    team: NDArray[np.void] = NO_TEAM
    values: NDArray[np.void] = NO_VALUES


class BlockHeader(NamedTuple):
    """Origin of a block.

    Fields: version of the block layout; worker, its incarnation, and the block's sequence number within the
    incarnation; policy version (updates applied to the weights that acted), and wall time at which these weights were
    published; exploration rate; env steps in the block; transitions that this incarnation has made, this block's
    included.
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
    """What a rollout worker pushes: packed transitions, and the episodes that ended while they were collected."""

    header: BlockHeader
    packed: Packed
    episodes: EpisodeStats

    @property
    def transitions(self) -> int:
        """Number of transitions."""
        return len(self.packed.rows)


class AddReply(NamedTuple):
    """A shard's reply to a push.

    Fields: transitions stored; whether the block was refused as a duplicate; version of the shard's weights; these
    weights, or None if they are no newer than the block's; whether a refused block was never stored because its worker
    has been replaced or a later block arrived first.
    """

    stored: int
    duplicate: bool
    weights_version: int
    weights: WeightsSnapshot | None
    outdated: bool = False


class Dropped(StrEnum):
    """Why a transition that a worker made is not stored."""

    DUPLICATE = "duplicate"
    """The shard has stored it already."""
    OUTDATED = "outdated"
    """A later block of its worker arrived first."""
    SHARD_LOST = "shard lost"
    """The shard it was sent to is gone."""
    WORKER_LOST = "worker lost"
    """Its worker failed before it was pushed."""


ACTS, STORES, WAITS = "acts", "stores", "waits"
"""What a rollout worker spends time on: stepping environments, waiting for replies to pushes, waiting for a call."""


class BlockReport(NamedTuple):
    """What a rollout worker tells the training loop about a block, without its transitions.

    Fields: header and finished episodes of the block; transitions stored; age of the acting weights when the block was
    stored, in updates and in seconds; transitions in the block; shard it was pushed to and the shard's incarnation;
    why it was not stored, if it was not, and the shard's fault behind that; seconds that the worker has spent on each
    activity since its last report (ACTS, STORES, WAITS).
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
    """Totals of the blocks that a shard has stored of one worker incarnation; `made` is the highest in its headers."""

    rows: int = 0
    env_steps: int = 0
    episodes: int = 0
    made: int = 0


class Draws(NamedTuple):
    """How the rows of a prioritised sample were drawn.

    `insertion_index` `[count]` counts the rows that the shard has stored: a slot's next row has another index, so that
    stale priority updates are detected. `probability` `[count]` is the probability of the draw within the shard.
    """

    insertion_index: NDArray[np.int64]
    probability: NDArray[np.float64]


class SampleReply(NamedTuple):
    """A sample of a shard's transitions.

    `columns` holds arrays `[count, ...]` under the names of `transition_dtype`. `mass` is the weight of the shard when
    the learner chooses between shards (see ReplayShard.mass). `draws` is None if the shard samples uniformly.
    """

    columns: dict[str, NDArray[Any]]
    mass: float
    draws: Draws | None


def transition_dtype(observation_space: gym.spaces.Box) -> np.dtype[Any]:
    """Structured dtype of one unpacked n-step transition: (s_t, a_t, n-step return, discount, s_{t+n}).

    `discount` multiplies the value of `next_observation`: gamma^n, or 0 if the task terminated. A timeout keeps its
    discount, since its last state is not terminal.
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
