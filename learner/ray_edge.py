"""The module that knows Ray (sweeps have `tune_edge`): it places the plain classes as Ray actors and calls them.

Rollout workers push to the shards themselves; the driver holds references and small reports only. The
embedded shards live in the learner's actor; with `replay_placement = "actors"` each has its own.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import ray
from ray.actor import ActorHandle

from actors.calls import LocalCalls, Node, Ref
from actors.evaluator import Candidate, evaluate_in_parts
from actors.nodes import RolloutNode, ShardNode
from actors.transitions import EpisodeStats
from actors.vector_env import EnvSpec, env_shape
from learner.cluster import Cluster, learner_settings, rollout_settings, shard_settings
from learner.config import RunConfig
from learner.node import LearnerNode
from learner.ray_auth import HOW, set_auth_mode
from sim_core.checks import ConfigError

PUSHES_IN_FLIGHT = 1
"""Pushes of a worker that may be under way while it collects the next block."""
COLLECTS_IN_FLIGHT = 2
"""Collects of a worker that are started ahead, so that it never waits for the driver."""
UPDATES_IN_FLIGHT = 2
"""Calls of updates that are started ahead, so that the learner never waits for the driver."""
DEADLINE_S = 300.0
"""A call that has not ended by then means that a part of the service hangs."""
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@lru_cache
def _task(function: Callable[..., Any]) -> Any:
    return ray.remote(num_cpus=0)(function)


class RayCalls:
    """Calls of Ray actors; implements `actors.calls.Calls`."""

    def start(self, node: Node, method: str, *args: Any) -> Ref:
        """Starts an actor's method."""
        return getattr(node, method).remote(*args)

    def run(self, function: Callable[..., Any], *args: Any) -> Ref:
        """Starts a function as a Ray task; it takes no CPU slot, so that it never waits for the run's own actors."""
        return _task(function).remote(*args)

    def wait(self, refs: list[Ref]) -> list[Ref]:
        """Blocks until one of `refs` is there; returns all that are, in the given order.

        Raises:
          TimeoutError: none was there within the deadline.
        """
        ready, _ = ray.wait(refs, num_returns=1, timeout=DEADLINE_S, fetch_local=False)
        if not ready:
            raise TimeoutError(f"none of {len(refs)} calls under way ended within {DEADLINE_S:.0f} s")
        ready, _ = ray.wait(refs, num_returns=len(refs), timeout=0, fetch_local=False)
        return [ref for ref in refs if ref in set(ready)]

    def get(self, ref: Ref) -> Any:
        """The result behind `ref`."""
        return ray.get(ref, timeout=DEADLINE_S)

    def put(self, value: Any) -> Ref:
        """Puts a value into the object store."""
        return ray.put(value)


def _make_learner(config: RunConfig, shards: list[Node]) -> LearnerNode:
    """Builds the learner in its actor; without shard actors, its shards too."""
    shape = env_shape(config.env)
    if shards:
        return LearnerNode(learner_settings(config, shape), shards, RayCalls(), RayCalls())
    embedded: list[Node] = [ShardNode(settings) for settings in shard_settings(config, shape)]
    return LearnerNode(learner_settings(config, shape), embedded, LocalCalls(), RayCalls())


class LearnerActor(LearnerNode):
    """LearnerNode built from the config, so that no large constructor argument breaks a restart."""

    def __init__(self, config: RunConfig, shards: list[Node]) -> None:
        self.__dict__ = _make_learner(config, shards).__dict__


def cpus_needed(config: RunConfig) -> int:
    """CPU slots that the run's actors take: one a rollout worker, shard actor and learner."""
    shards = config.replay_shards if config.replay_placement == "actors" else 0
    return config.workers + shards + 1


def cluster_cpus() -> int:
    """CPU slots of the cluster that this process has joined."""
    return int(ray.cluster_resources().get("CPU", 0))


def connect(cpus: int, address: str | None) -> None:
    """Joins the cluster at `address`, or starts Ray on this machine with room for `cpus` CPU slots.

    Raises:
      ConfigError: the cluster cannot be reached or has too few CPUs.
    """
    set_auth_mode(address is not None)
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    options: dict[str, Any] = {"address": address}
    if address is None:
        options = {"address": "local", "include_dashboard": False, "num_cpus": max(cpus, os.cpu_count() or 1)}
    try:
        ray.init(logging_level="ERROR", runtime_env={"env_vars": ONE_THREAD}, **options)
    except ConnectionError as error:
        raise ConfigError(
            f"no Ray cluster answers at {address!r}; start one with `ray start --head`, or for one with tokens {HOW}"
        ) from error
    have = cluster_cpus()
    if have < cpus:
        ray.shutdown()
        raise ConfigError(
            f"the run needs {cpus} CPUs (one a rollout worker, shard actor and learner), the cluster has {have}: "
            "lower workers or replay_shards, or add nodes"
        )


def evaluate_in_tasks(spec: EnvSpec, candidate: Candidate, seeds: list[int], address: str | None) -> EpisodeStats:
    """Plays one episode a seed in Ray tasks on all CPUs (see `connect` for errors).

    Returns:
      One entry a seed, in order.
    """
    connect(1, address)
    calls = RayCalls()
    try:
        return evaluate_in_parts(calls, spec, calls.put(candidate), seeds, cluster_cpus())
    finally:
        ray.shutdown()


def ray_cluster(config: RunConfig, incarnation: int, address: str | None) -> Cluster:
    """Places the run's parts as Ray actors (see `connect` for errors)."""
    connect(cpus_needed(config), address)
    calls = RayCalls()
    shape = env_shape(config.env)
    shards: list[Node] = []
    if config.replay_placement == "actors":
        shards = [ray.remote(num_cpus=1)(ShardNode).remote(settings) for settings in shard_settings(config, shape)]
    learner = ray.remote(num_cpus=1)(LearnerActor).remote(config, shards)
    targets: list[ActorHandle] = shards or [learner]
    workers: list[Node] = [
        ray.remote(num_cpus=1)(RolloutNode).remote(
            rollout_settings(config), worker_id, incarnation, calls, targets, PUSHES_IN_FLIGHT
        )
        for worker_id in range(config.workers)
    ]
    return Cluster(
        calls=calls,
        learner=learner,
        workers=workers,
        collects_in_flight=COLLECTS_IN_FLIGHT,
        blocks_in_flight=config.workers * (COLLECTS_IN_FLIGHT + PUSHES_IN_FLIGHT),
        updates_in_flight=UPDATES_IN_FLIGHT,
        eval_tasks=cluster_cpus(),
        close=ray.shutdown,
    )
