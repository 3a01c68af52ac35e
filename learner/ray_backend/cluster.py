"""The module that knows Ray (sweeps have `tune_edge`): it places the plain classes as Ray actors and calls them.

Rollout workers push to the shards themselves; the driver holds references and small reports only. The
embedded shards live in the learner's actor; with `replay_placement = "actors"` each has its own.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from typing import Any, TypeVar, TypeVarTuple

import psutil
import ray
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
from actors.service.rpc import Handle, LocalCalls, Ref, local_handle
from learner.config import RunConfig
from learner.placement import DEADLINE_S, Place
from learner.ray_backend.auth import HOW, guard_ray
from learner.training.cluster import (
    Cluster,
    Limits,
    rollout_settings,
    shard_settings,
)
from learner.update.learner_node import LearnerNode
from sim_core.checks import ConfigError, require

N = TypeVar("N")
T = TypeVar("T")
Ts = TypeVarTuple("Ts")

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

    def start(self, node: Handle[N], method: Callable[[N, *Ts], T], *args: *Ts) -> Ref[T]:
        """Starts an actor's method."""
        ref: Ref[T] = getattr(node, method.__name__).remote(*args)
        return ref

    def run(self, function: Callable[[*Ts], T], *args: *Ts) -> Ref[T]:
        """Starts a function as a Ray task; it takes no CPU slot, so that it never waits for the run's own actors."""
        ref: Ref[T] = _task(function).remote(*args)
        return ref

    def wait(self, refs: list[Ref[T]], timeout_s: float) -> list[Ref[T]]:
        """Blocks until one of `refs` is there or the time is over; returns all that are, in the given order."""
        ray.wait(refs, num_returns=1, timeout=timeout_s, fetch_local=False)
        ready, _ = ray.wait(refs, num_returns=len(refs), timeout=0, fetch_local=False)
        return [ref for ref in refs if ref in set(ready)]

    def get(self, ref: Ref[T]) -> T:
        """The result behind `ref`.

        Raises:
          CallFailed: the call could not be made, its result is gone, or the deadline passed.
        """
        try:
            result: T = ray.get(ref, timeout=self._deadline_s)
            return result
        except GetTimeoutError as error:
            raise CallFailed(Fault.LATE, f"no answer within {self._deadline_s:.0f} s") from error
        except RayError as error:
            fault = _as_fault(error)
            if fault is error:
                raise
            raise fault from error

    def put(self, value: T) -> Ref[T]:
        """Puts a value into the object store."""
        ref: Ref[T] = ray.put(value)
        return ref


class LearnerActor(LearnerNode):
    """LearnerNode that is made in its actor; it embeds the shards if they have no actors of their own.

    Args:
      config: the run.
      shards: actors of the shards, or none.
      calls: how to call them.
    """

    def __init__(self, config: RunConfig, shards: list[Handle[ShardNode]], calls: RayCalls) -> None:
        shape = env_shape(config.env)
        if shards:
            super().__init__(config, shape, shards, calls, prefetch=config.replay == "uniform")
        else:
            embedded = [local_handle(ShardNode(shard)) for shard in shard_settings(config, shape)]
            super().__init__(config, shape, embedded, LocalCalls())


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


class RayCluster(Cluster):
    """The nodes of a run as Ray actors.

    Args:
      config: the run.
      incarnation: see Cluster.
      options: the cluster's address, and deadlines.

    Raises:
      ConfigError: see `connect` and `learner_gpus`.
    """

    def __init__(self, config: RunConfig, incarnation: int, options: Place) -> None:
        connect(cpus_needed(config), options.address)
        self._shape = env_shape(config.env)
        self._node_calls = RayCalls(options.deadline_s * INNER_SHARE)
        limits = Limits(
            deadline_s=options.deadline_s,
            start_deadline_s=options.start_deadline_s,
            collects_in_flight=COLLECTS_IN_FLIGHT,
            blocks_in_flight=config.workers * (COLLECTS_IN_FLIGHT + PUSHES_IN_FLIGHT),
            updates_in_flight=UPDATES_IN_FLIGHT,
            eval_tasks=cluster_cpus(),
        )
        calls = RayCalls(max(options.deadline_s, options.start_deadline_s))
        super().__init__(config, incarnation, calls, limits)

    def place_learner(self) -> Handle[LearnerNode]:
        """Starts the learner's actor, which embeds the shards if they have no actors of their own."""
        return _start_actor(LearnerActor, learner_gpus(self.config), self.config, self.shards, self._node_calls)

    def place_worker(self, worker_id: int, incarnation: int) -> Handle[RolloutNode]:
        """Starts the actor of a rollout worker."""
        settings = rollout_settings(self.config)
        arguments = (settings, worker_id, incarnation, self._node_calls, self.targets, PUSHES_IN_FLIGHT)
        return _start_actor(RolloutNode, 0, *arguments)

    def place_shard(self, index: int, incarnation: int) -> Handle[ShardNode]:
        """Starts the actor of an empty shard."""
        return _start_actor(ShardNode, 0, shard_settings(self.config, self._shape, incarnation)[index])

    def discard(self, node: Handle[Any]) -> None:
        """Kills an actor."""
        ray.kill(node)

    def cancel(self, ref: Ref[Any]) -> None:
        """Cancels a task; Ray kills its process if it does not end by itself."""
        ray.cancel(ref, force=True)

    def abandon(self) -> None:
        """Kills all actors."""
        for node in (*self.shards, self.learner, *self.workers):
            ray.kill(node)

    def close(self) -> None:
        """Leaves the cluster (see `leave`)."""
        leave()


def _start_actor(kind: Callable[[*Ts], N], gpus: int, *args: *Ts) -> Handle[N]:
    """Starts `kind(*args)` as a Ray actor; Ray must not restart it, since it does not know the incarnation."""
    actor = ray.remote(num_cpus=1, num_gpus=gpus, max_restarts=0, max_task_retries=0)(kind)
    handle: Handle[N] = actor.remote(*args)
    return handle
