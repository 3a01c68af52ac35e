"""The nodes of a run and how to place them; here all in this process, in `learner.ray_backend` as Ray actors."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from actors.replay.node import ShardNode, ShardSettings
from actors.replay.prioritised import PrioritySettings
from actors.rollout.node import PushTarget, RolloutNode
from actors.rollout.vector_env import EnvShape, env_shape
from actors.rollout.worker import RolloutSettings
from actors.service.fault_policy import ComponentFailed
from actors.service.messages import transition_dtype
from actors.service.rpc import Calls, Handle, LocalCalls, Ref, local_handle
from learner.checkpoints.writer import Checkpointable
from learner.config import RunConfig
from learner.update.learner_node import LearnerNode

LAST_WRITE_S = 60.0
"""How long nodes of this process may go on writing after an error; a disk that hangs must not hide that error."""


def rollout_settings(config: RunConfig) -> RolloutSettings:
    """The rollout workers' settings of a run."""
    return RolloutSettings(
        env=config.env,
        num_envs=config.envs_per_worker,
        steps_per_block=config.steps_per_block,
        n_step=config.n_step,
        discount=config.decision_discount,
        seed=config.seed,
    )


def shard_settings(config: RunConfig, shape: EnvShape, incarnation: int = 0) -> list[ShardSettings]:
    """The settings of each shard of a run; a shard that replaces a lost one draws from another random stream."""
    entropy = (config.seed, 2, incarnation) if incarnation else (config.seed, 2)
    seeds = np.random.SeedSequence(entropy).generate_state(config.replay_shards)
    capacity = config.replay_capacity // config.replay_shards
    dtype = transition_dtype(shape.observation_space)
    priorities = None
    if config.replay == "prioritised":
        priorities = PrioritySettings(config.priority_exponent, config.batch_size)
    return [ShardSettings(dtype, capacity, int(seed), priorities) for seed in seeds]


class Limits(NamedTuple):
    """How long a component may be silent, and how many calls may be in flight.

    A component is late once it owes an answer for `deadline_s`, or for `start_deadline_s` if it has never answered.
    `collects_in_flight` counts collects per rollout worker, `blocks_in_flight` the blocks of all workers that are
    ordered and not yet stored, `updates_in_flight` messages that ask for updates, `eval_tasks` the tasks of one final
    evaluation. A message asks for as many calls of updates as take `message_s` together, and for one at least.
    """

    deadline_s: float
    start_deadline_s: float
    collects_in_flight: int
    blocks_in_flight: int
    updates_in_flight: int
    eval_tasks: int
    message_s: float = 0.0

    @property
    def queue_deadline_s(self) -> float:
        """Deadline of a call that is queued behind those in flight, each of which may take `deadline_s`."""
        return self.deadline_s * (1 + max(self.collects_in_flight, self.updates_in_flight))


class Cluster(ABC):
    """The nodes of a run, and how to place and replace them.

    Args:
      config: the run.
      incarnation: of the learner and of the first rollout workers; shards begin with 0.
      calls: how to call the nodes.
      limits: see Limits.

    Attributes:
      learner, workers: their nodes.
      shards: the nodes of the replay shards; empty if the learner embeds them.
    """

    def __init__(self, config: RunConfig, incarnation: int, calls: Calls, limits: Limits) -> None:
        self.config = config
        self.incarnation = incarnation
        self.calls = calls
        self.limits = limits
        own_shards = config.replay_shards if config.replay_placement == "actors" else 0
        self.shards = [self.place_shard(index, 0) for index in range(own_shards)]
        self.learner = self.place_learner()
        self.workers = [self.place_worker(worker_id, incarnation) for worker_id in range(config.workers)]

    @property
    def targets(self) -> Sequence[Handle[PushTarget]]:
        """What rollout workers push to: the shards, or else the learner alone."""
        return self.shards or [self.learner]

    @property
    def capacities(self) -> list[int]:
        """Transitions that each target can hold."""
        return [self.config.replay_capacity // len(self.targets)] * len(self.targets)

    @abstractmethod
    def place_learner(self) -> Handle[LearnerNode]:
        """Makes the learner, which samples from the present `shards`."""

    @abstractmethod
    def place_worker(self, worker_id: int, incarnation: int) -> Handle[RolloutNode]:
        """Makes a rollout worker, which pushes to the present `targets`."""

    @abstractmethod
    def place_shard(self, index: int, incarnation: int) -> Handle[ShardNode]:
        """Makes an empty shard."""

    @abstractmethod
    def keep_spares(self) -> None:
        """Starts the warm spares that are missing, in the background."""

    @abstractmethod
    def discard(self, node: Handle[Any]) -> None:
        """Ends a node."""

    @abstractmethod
    def cancel(self, ref: Ref[Any]) -> None:
        """Ends a call that nobody waits for any more."""

    @abstractmethod
    def abandon(self) -> None:
        """Ends all nodes and what they write."""

    @abstractmethod
    def close(self) -> None:
        """Frees everything."""


class ProcessCluster(Cluster):
    """All nodes in this process, one call at a time: deterministic.

    Args:
      config: the run.
      incarnation: see Cluster.
      calls: how the nodes call each other, LocalCalls by default.
    """

    def __init__(self, config: RunConfig, incarnation: int, calls: Calls | None = None) -> None:
        self._shape = env_shape(config.env)
        limits = Limits(
            deadline_s=math.inf,
            start_deadline_s=math.inf,
            collects_in_flight=1,
            blocks_in_flight=config.workers,
            updates_in_flight=1,
            eval_tasks=1,
        )
        super().__init__(config, incarnation, calls or LocalCalls(), limits)

    def place_learner(self) -> Handle[LearnerNode]:
        """Makes the learner, with shards of its own if there are no others."""
        shards = self.shards or [self.place_shard(index, 0) for index in range(self.config.replay_shards)]
        return local_handle(LearnerNode(self.config, self._shape, shards, self.calls))

    def place_worker(self, worker_id: int, incarnation: int) -> Handle[RolloutNode]:
        """Makes a rollout worker whose pushes are stored when `collect` returns."""
        settings = rollout_settings(self.config)
        return local_handle(RolloutNode(settings, worker_id, incarnation, self.calls, self.targets, 0))

    def place_shard(self, index: int, incarnation: int) -> Handle[ShardNode]:
        """Makes an empty shard."""
        return local_handle(ShardNode(shard_settings(self.config, self._shape, incarnation)[index]))

    def keep_spares(self) -> None:
        """Does nothing: a node of this process does not die by itself."""

    def discard(self, node: Handle[Any]) -> None:
        """Does nothing: whoever holds no handle of it frees it."""

    def cancel(self, ref: Ref[Any]) -> None:
        """Does nothing: the call has ended."""

    def abandon(self) -> None:
        """Waits until no node writes any more."""
        nodes: list[Handle[Checkpointable]] = [self.learner, *self.workers]
        for node in nodes:
            with suppress(ComponentFailed):  # what ended the attempt is the error to show
                LocalCalls().start(node, Checkpointable.saved, LAST_WRITE_S)

    def close(self) -> None:
        """Closes the rollout workers' environments."""
        for worker in self.workers:
            LocalCalls().start(worker, RolloutNode.close)
