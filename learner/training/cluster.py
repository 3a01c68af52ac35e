"""The parts of a run and how to call them; here all in one process, in `ray_edge` as Ray actors."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from actors.replay.node import ShardNode, ShardSettings
from actors.replay.prioritised import PrioritySettings
from actors.rollout.node import RolloutNode
from actors.rollout.vector_env import EnvShape, env_shape
from actors.rollout.worker import RolloutSettings
from actors.service.messages import transition_dtype
from actors.service.rpc import Calls, LocalCalls, Node
from learner.config import RunConfig
from learner.update.learner_node import LearnerNode
from learner.update.updates import LearnerSettings

LAST_WRITE_S = 60.0
"""How long parts of this process may go on writing after an error; a disk that hangs must not hide it."""


class Cluster(NamedTuple):
    """Nodes of a run, how to replace them, and how many calls each may have under way.

    Workers push to `targets`: to shards that are parts of their own, or to the learner alone. `place_worker` and
    `place_shard` take an index and an incarnation; `discard` ends a node or a call. A part that is silent for
    `deadline_s` is late, one that has not answered yet for `start_deadline_s`. `collects_in_flight` counts
    collects per worker, `updates_in_flight` calls of updates, `eval_tasks` the tasks of one final evaluation.
    `abandon` ends all parts and what they write, `close` frees everything.
    """

    calls: Calls
    incarnation: int
    learner: Node
    workers: list[Node]
    targets: list[Node]
    shards_are_parts: bool
    place_worker: Callable[[int, int], Node]
    place_shard: Callable[[int, int], Node]
    discard: Callable[[Any], None]
    deadline_s: float
    start_deadline_s: float
    collects_in_flight: int
    blocks_in_flight: int
    updates_in_flight: int
    eval_tasks: int
    abandon: Callable[[], None]
    close: Callable[[], None]

    @property
    def queue_deadline_s(self) -> float:
        """The deadline of a part that first does what it was told before, each call of it within `deadline_s`."""
        return self.deadline_s * (1 + max(self.collects_in_flight, self.updates_in_flight))

    def capacities(self, config: RunConfig) -> list[int]:
        """Transitions that each target can hold."""
        if not self.shards_are_parts:
            return [config.replay_capacity]
        return [config.replay_capacity // config.replay_shards] * config.replay_shards


def learner_settings(config: RunConfig, shape: EnvShape) -> LearnerSettings:
    """The learner's part of the config."""
    return LearnerSettings(
        observation_size=shape.observation_size,
        num_actions=shape.num_actions,
        hidden_sizes=config.hidden_sizes,
        double=config.algorithm == "double_dqn",
        batch_size=config.batch_size,
        target_update_interval=config.target_update_interval,
        max_gradient_norm=config.max_gradient_norm,
        gradients=config.gradients,
        seed=config.seed,
        network=config.network,
        loss=config.loss,
        soft_target_rate=config.target_update_rate if config.target_update == "soft" else None,
        device=config.device,
    )


def rollout_settings(config: RunConfig) -> RolloutSettings:
    """The rollout workers' part of the config."""
    return RolloutSettings(
        env=config.env,
        num_envs=config.envs_per_worker,
        steps_per_block=config.steps_per_block,
        n_step=config.n_step,
        discount=config.discount,
        seed=config.seed,
    )


def shard_settings(config: RunConfig, shape: EnvShape, incarnation: int = 0) -> list[ShardSettings]:
    """The shards' part of the config, one a shard; a shard that replaces a lost one draws from another stream."""
    entropy = (config.seed, 2, incarnation) if incarnation else (config.seed, 2)
    seeds = np.random.SeedSequence(entropy).generate_state(config.replay_shards)
    capacity = config.replay_capacity // config.replay_shards
    dtype = transition_dtype(shape.observation_space)
    priorities = None
    if config.replay == "prioritised":
        priorities = PrioritySettings(config.priority_exponent, config.batch_size)
    return [ShardSettings(dtype, capacity, int(seed), priorities) for seed in seeds]


def process_cluster(config: RunConfig, incarnation: int) -> Cluster:
    """All parts in this process, one call at a time: deterministic."""
    calls = LocalCalls()
    shape = env_shape(config.env)
    shards: list[Node] = [ShardNode(settings) for settings in shard_settings(config, shape)]
    learner = LearnerNode(learner_settings(config, shape), shards, calls)
    targets = [learner] if config.replay_placement == "learner" else shards

    def place_worker(worker_id: int, incarnation: int) -> Node:
        return RolloutNode(rollout_settings(config), worker_id, incarnation, calls, targets, 0)

    workers = [place_worker(worker_id, incarnation) for worker_id in range(config.workers)]

    def abandon() -> None:
        for node in (learner, *workers):
            node.saved(LAST_WRITE_S)

    return Cluster(
        calls=calls,
        incarnation=incarnation,
        learner=learner,
        workers=workers,
        targets=targets,
        shards_are_parts=config.replay_placement == "actors",
        place_worker=place_worker,
        place_shard=lambda index, incarnation: ShardNode(shard_settings(config, shape, incarnation)[index]),
        discard=lambda node: None,
        deadline_s=math.inf,
        start_deadline_s=math.inf,
        collects_in_flight=1,
        blocks_in_flight=config.workers,
        updates_in_flight=1,
        eval_tasks=1,
        abandon=abandon,
        close=lambda: None,
    )
