"""The parts of a run and how to call them; here all in one process, in `ray_edge` as Ray actors."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from actors.calls import Calls, LocalCalls, Node
from actors.nodes import RolloutNode, ShardNode, ShardSettings
from actors.prioritised import PrioritySettings
from actors.rollout import RolloutSettings
from actors.transitions import transition_dtype
from actors.vector_env import EnvShape, env_shape
from learner.config import RunConfig
from learner.learner import LearnerSettings
from learner.node import LearnerNode


class Cluster(NamedTuple):
    """Nodes of a run, and how many calls each may have under way.

    `collects_in_flight` counts collects per worker, `updates_in_flight` calls of updates, `eval_tasks` the
    tasks of one final evaluation; `close` frees everything.
    """

    calls: Calls
    learner: Node
    workers: list[Node]
    collects_in_flight: int
    blocks_in_flight: int
    updates_in_flight: int
    eval_tasks: int
    close: Callable[[], None]


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


def shard_settings(config: RunConfig, shape: EnvShape) -> list[ShardSettings]:
    """The shards' part of the config, one a shard."""
    seeds = np.random.SeedSequence((config.seed, 2)).generate_state(config.replay_shards)
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
    learner = LearnerNode(learner_settings(config, shape), shards, calls, calls)
    targets = [learner] if config.replay_placement == "learner" else shards
    workers: list[Node] = [
        RolloutNode(rollout_settings(config), worker_id, incarnation, calls, targets, 0)
        for worker_id in range(config.workers)
    ]
    return Cluster(
        calls=calls,
        learner=learner,
        workers=workers,
        collects_in_flight=1,
        blocks_in_flight=config.workers,
        updates_in_flight=1,
        eval_tasks=1,
        close=lambda: None,
    )
