"""The module that knows Ray (sweeps have `tune_edge`): it places the plain classes as Ray actors and calls them.

Rollout workers push to the shards themselves; the driver holds references and small reports only. The
embedded shards live in the learner's actor; with `replay_placement = "actors"` each has its own.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from typing import Any

import psutil
import ray
from ray.actor import ActorHandle
from ray.exceptions import (
    ActorUnavailableError,
    AuthenticationError,
    GetTimeoutError,
    NodeDiedError,
    ObjectLostError,
    OutOfMemoryError,
    RayActorError,
    RayError,
    RayTaskError,
    TaskCancelledError,
    WorkerCrashedError,
)

from actors.evaluation.evaluator import Candidate, evaluate_in_parallel
from actors.replay.node import ShardNode
from actors.rollout.node import RolloutNode
from actors.rollout.vector_env import EnvSpec, env_shape
from actors.service.fault_policy import CallFailed, ComponentFailed, Fault, first_line
from actors.service.messages import EpisodeStats
from actors.service.rpc import LocalCalls, Node, Ref
from learner.config import RunConfig
from learner.placement import DEADLINE_S, Place
from learner.ray_backend.auth import HOW, guard_ray
from learner.training.cluster import Cluster, learner_settings, rollout_settings, shard_settings
from learner.update.learner_node import LearnerNode
from sim_core.checks import ConfigError, require

PUSHES_IN_FLIGHT = 2
"""Pushes of a worker that may be under way while it collects: shards that live with the learner wait for updates."""
COLLECTS_IN_FLIGHT = 2
"""Collects of a worker that are started ahead, so that it never waits for the driver."""
UPDATES_IN_FLIGHT = 2
"""Calls of updates that are started ahead, so that the learner never waits for the driver."""
INNER_SHARE = 0.3
"""Share of the deadline that parts give each other, so that one that waits, twice in a row, is not itself late."""
RAYLET = "raylet"
"""Name of the process that a Ray of our own starts its workers from."""
FAULTS: tuple[tuple[tuple[type[Exception], ...], Fault], ...] = (
    ((ActorUnavailableError,), Fault.UNREACHABLE),
    ((RayActorError, WorkerCrashedError, NodeDiedError, OutOfMemoryError, TaskCancelledError), Fault.DIED),
    ((ObjectLostError,), Fault.OBJECT_LOST),
    ((GetTimeoutError,), Fault.LATE),
)
"""What errors of Ray mean; the first match counts."""
OWN_RAY = {
    "idle_worker_killing_time_threshold_ms": 24 * 3_600_000,
    "task_events_report_interval_ms": 0,
    "max_direct_call_object_size": 2**20,
}
"""Settings of a Ray of our own. It keeps processes that wait for tasks: evaluations are tasks beside actors that take
all CPU slots, and Ray would end their process after a second and start the next one from nothing. It keeps no list of
the last 100,000 calls, 300 MB that only its dashboard would show, and there is none. And it sends blocks of up to a
MiB in the call itself; past its own 100 KiB they would go through the object store, which costs several calls more."""
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@lru_cache
def _task(function: Callable[..., Any]) -> Any:
    return ray.remote(num_cpus=0, max_retries=0)(function)


def _as_fault(error: Exception) -> Exception:
    """What an error of Ray means; what our own code raised stays as it is."""
    if isinstance(error, RayTaskError):
        cause = getattr(error, "cause", None)
        if isinstance(cause, CallFailed | ComponentFailed):
            return cause
        return _as_fault(cause) if isinstance(cause, RayError) else error
    for kinds, fault in FAULTS:
        if isinstance(error, kinds):
            return CallFailed(fault, first_line(error))
    return error


class RayCalls:
    """Calls of Ray actors; implements `actors.service.rpc.Calls`.

    Args:
      deadline_s: `get` waits no longer.
    """

    def __init__(self, deadline_s: float) -> None:
        self._deadline_s = deadline_s

    def start(self, node: Node, method: str, *args: Any) -> Ref:
        """Starts an actor's method."""
        return getattr(node, method).remote(*args)

    def run(self, function: Callable[..., Any], *args: Any) -> Ref:
        """Starts a function as a Ray task; it takes no CPU slot, so that it never waits for the run's own actors."""
        return _task(function).remote(*args)

    def wait(self, refs: list[Ref], timeout_s: float) -> list[Ref]:
        """Blocks until one of `refs` is there or the time is over; returns all that are, in the given order."""
        ray.wait(refs, num_returns=1, timeout=timeout_s, fetch_local=False)
        ready, _ = ray.wait(refs, num_returns=len(refs), timeout=0, fetch_local=False)
        return [ref for ref in refs if ref in set(ready)]

    def get(self, ref: Ref) -> Any:
        """The result behind `ref`.

        Raises:
          CallFailed: the call could not be made, its result is gone, or the deadline passed.
        """
        try:
            return ray.get(ref, timeout=self._deadline_s)
        except GetTimeoutError as error:
            raise CallFailed(Fault.LATE, f"no answer within {self._deadline_s:.0f} s") from error
        except RayError as error:
            fault = _as_fault(error)
            if fault is error:
                raise
            raise fault from error

    def put(self, value: Any) -> Ref:
        """Puts a value into the object store."""
        return ray.put(value)


def _make_learner(config: RunConfig, shards: list[Node], calls: RayCalls) -> LearnerNode:
    """Builds the learner in its actor; without shard actors, its shards too."""
    shape = env_shape(config.env)
    settings = learner_settings(config, shape)
    if shards:
        return LearnerNode(settings, shards, calls, draws_ahead=config.replay == "uniform")
    embedded: list[Node] = [ShardNode(settings) for settings in shard_settings(config, shape)]
    return LearnerNode(settings, embedded, LocalCalls())


class LearnerActor(LearnerNode):
    """LearnerNode built from the config, so that no large constructor argument breaks a restart."""

    def __init__(self, config: RunConfig, shards: list[Node], calls: RayCalls) -> None:
        self.__dict__ = _make_learner(config, shards, calls).__dict__


def cpus_needed(config: RunConfig) -> int:
    """CPU slots that the run's actors take: one a rollout worker, shard actor and learner."""
    shards = config.replay_shards if config.replay_placement == "actors" else 0
    return config.workers + shards + 1


def cluster_cpus() -> int:
    """CPU slots of the cluster that this process has joined."""
    return int(ray.cluster_resources().get("CPU", 0))


def learner_gpus(config: RunConfig) -> int:
    """GPUs to keep for the learner in the cluster that this process has joined.

    Raises:
      ConfigError: the config wants CUDA, and the cluster has no GPU.
    """
    if config.device == "cpu":
        return 0
    resources = ray.cluster_resources() if config.device == "cuda" else ray.available_resources()
    have = resources.get("GPU", 0) >= 1
    require(have or config.device == "auto", "device is cuda, but the cluster has no GPU; give --device auto or cpu")
    return int(have)


def connect(cpus: int, address: str | None) -> None:
    """Joins the cluster at `address`, or starts Ray on this machine with room for `cpus` CPU slots.

    Raises:
      ConfigError: the cluster cannot be reached, wants another token, or has too few CPUs.
    """
    if ray.is_initialized():
        return  # an earlier attempt of this run has joined
    guard_ray(address is not None)
    os.environ.setdefault("RAY_IGNORE_UNHANDLED_ERRORS", "1")  # of calls to parts that have been replaced
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    options: dict[str, Any] = {"address": address}
    if address is None:
        options = {"address": "local", "include_dashboard": False, "num_cpus": max(cpus, os.cpu_count() or 1)}
        options["_system_config"] = OWN_RAY
    try:
        ray.init(logging_level="ERROR", runtime_env={"env_vars": ONE_THREAD}, **options)
    except (ConnectionError, AuthenticationError) as error:
        raise ConfigError(
            f"no Ray cluster answers at {address!r}; start one with `ray start --head`, or for one with tokens {HOW}"
        ) from error
    have = cluster_cpus()
    if have < cpus:
        leave()
        raise ConfigError(
            f"the run needs {cpus} CPUs (one a rollout worker, shard actor and learner), the cluster has {have}: "
            "lower workers or replay_shards, or add nodes"
        )


def leave() -> None:
    """Leaves the cluster; a Ray of our own ends with all of its processes.

    A worker of Ray may hang for good in its own end, after its raylet has gone, and Ray looks after it no more.
    """
    raylets = [child for child in psutil.Process().children() if child.name() == RAYLET]
    family = [process for raylet in raylets for process in raylet.children(recursive=True)]
    ray.shutdown()
    for process in family:
        with suppress(psutil.NoSuchProcess):
            process.kill()


def evaluate_in_tasks(spec: EnvSpec, candidate: Candidate, seeds: list[int], address: str | None) -> EpisodeStats:
    """Plays one episode a seed in Ray tasks on all CPUs (see `connect` for errors).

    Returns:
      One entry a seed, in order.
    """
    connect(1, address)
    calls = RayCalls(DEADLINE_S)
    try:
        return evaluate_in_parallel(calls, spec, calls.put(candidate), seeds, cluster_cpus())
    finally:
        leave()


def ray_cluster(config: RunConfig, incarnation: int, place: Place) -> Cluster:
    """Places the run's parts as Ray actors (see `connect` for errors)."""
    connect(cpus_needed(config), place.address)
    inner = RayCalls(place.deadline_s * INNER_SHARE)
    shape = env_shape(config.env)
    own = config.replay_placement == "actors"

    def place_shard(index: int, incarnation: int) -> Node:
        return _actor(ShardNode).remote(shard_settings(config, shape, incarnation)[index])

    shards = [place_shard(index, 0) for index in range(config.replay_shards)] if own else []
    learner = _actor(LearnerActor, learner_gpus(config)).remote(config, shards, inner)
    targets = shards or [learner]

    def place_worker(worker_id: int, incarnation: int) -> Node:
        settings = rollout_settings(config)
        return _actor(RolloutNode).remote(settings, worker_id, incarnation, inner, targets, PUSHES_IN_FLIGHT)

    workers = [place_worker(worker_id, incarnation) for worker_id in range(config.workers)]

    def abandon() -> None:
        for node in {*targets, learner, *workers}:
            _discard(node)

    return Cluster(
        calls=RayCalls(max(place.deadline_s, place.start_deadline_s)),
        incarnation=incarnation,
        learner=learner,
        workers=workers,
        targets=targets,
        shards_are_parts=own,
        place_worker=place_worker,
        place_shard=place_shard,
        discard=_discard,
        deadline_s=place.deadline_s,
        start_deadline_s=place.start_deadline_s,
        collects_in_flight=COLLECTS_IN_FLIGHT,
        blocks_in_flight=config.workers * (COLLECTS_IN_FLIGHT + PUSHES_IN_FLIGHT),
        updates_in_flight=UPDATES_IN_FLIGHT,
        eval_tasks=cluster_cpus(),
        abandon=abandon,
        close=leave,
    )


def _actor(kind: type, gpus: int = 0) -> Any:
    """`kind` as a Ray actor; no restarts by Ray itself, which would not know the incarnation."""
    return ray.remote(num_cpus=1, num_gpus=gpus, max_restarts=0, max_task_retries=0)(kind)


def _discard(what: Any) -> None:
    """Ends an actor, or a call that nobody waits for any more. Ray kills a process that does not go by itself."""
    if isinstance(what, ActorHandle):
        ray.kill(what)
    else:
        ray.cancel(what, force=True)
