"""Places the nodes of a run as Ray actors.

Rollout workers push to the shards themselves; the driver holds references and small reports only. The shards are
embedded in the learner's actor, or with `replay_placement = "actors"` each is an actor of its own.
"""

from __future__ import annotations

import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar, TypeVarTuple

import psutil
import ray
from ray.exceptions import AuthenticationError

from actors.evaluation.evaluator import Candidate, evaluate, evaluate_in_parallel, is_short
from actors.policy.policy import WeightsSnapshot, blank_weights
from actors.replay.node import ShardNode
from actors.rollout.env_spec import EnvSpec
from actors.rollout.node import RolloutNode
from actors.rollout.vector_env import EnvShape, env_shape
from actors.service.fault_policy import CallFailed, RunFailed
from actors.service.messages import EpisodeStats
from actors.service.rpc import Handle, LocalCalls, Ref, local_handle
from learner.cluster_options import DEADLINE_S, ClusterOptions
from learner.config import RunConfig
from learner.ray_backend.auth import TOKEN_HELP, guard_ray
from learner.ray_backend.calls import RayCalls
from learner.ray_backend.lean_start import lean_start
from learner.ray_backend.spares import Spares, SpareShard, SpareWorker
from learner.ray_backend.temp_folder import own_temp_folder
from learner.training.cluster import (
    Cluster,
    Limits,
    rollout_settings,
    shard_settings,
)
from learner.training.stop_signals import Interrupted
from learner.update.learner_node import LearnerNode
from sim_core.checks import ConfigError, require

N = TypeVar("N")
Ts = TypeVarTuple("Ts")

PUSHES_IN_FLIGHT = 2
"""Pushes that a worker may have in flight while it collects: embedded shards answer only between calls of updates."""
COLLECTS_IN_FLIGHT = 2
"""Collects that a worker may have in flight, so that it never waits for the driver."""
UPDATES_IN_FLIGHT = 2
"""Messages that ask the learner for updates that may be in flight, so that it never waits for the driver."""
MESSAGE_S = 0.02
"""How long the updates of one message may take, where as many are due: a message costs the learner a millisecond."""
INNER_SHARE = 0.3
"""Share of the deadline that nodes give each other, so that a node that waits twice in a row is not itself late."""
RAYLET = "raylet"
"""Name of the process from which a local Ray starts its workers."""
LOCAL_RAY = {
    "idle_worker_killing_time_threshold_ms": 24 * 3_600_000,
    "task_events_report_interval_ms": 0,
    "max_direct_call_object_size": 2**20,
    "prestart_worker_first_driver": False,
}
"""Settings of a Ray that this process starts, each against a default that costs a run time or memory.

Idle worker processes are kept: an evaluation is a task beside actors that take all CPU slots, and Ray would kill its
process after a second and start the next one from nothing. The last 100,000 calls are not recorded: that takes 300 MB,
and only Ray's dashboard shows them. Blocks of up to 1 MiB travel in the call itself: above Ray's default of 100 KiB
they would go through the object store, which costs several more calls. Worker processes start when they are needed, not
one for each core of the machine."""
_own_folders: list[Path] = []
"""The folder of the Ray that this process has started, where it is not the one that Ray takes by itself."""
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


class LearnerActor(LearnerNode):
    """The learner's actor, which embeds the shards if they have no actors of their own.

    Args:
      config: the run.
      shape: spaces of its environment, which is not made in this process.
      shards: actors of the shards, or none.
      calls: how to call them.
    """

    def __init__(self, config: RunConfig, shape: EnvShape, shards: list[Handle[ShardNode]], calls: RayCalls) -> None:
        prefetch = config.replay == "uniform"
        if shards:
            super().__init__(config, shape, shards, calls, prefetch)
        else:
            embedded = [local_handle(ShardNode(shard)) for shard in shard_settings(config, shape)]
            super().__init__(config, shape, embedded, LocalCalls(), prefetch)


def cpus_needed(config: RunConfig) -> int:
    """CPU slots that the run's actors take: one each for a rollout worker, a shard actor and the learner."""
    shards = config.replay_shards if config.replay_placement == "actors" else 0
    return config.workers + shards + 1


def cluster_cpus() -> int:
    """CPU slots of the Ray cluster that this process has joined."""
    return int(ray.cluster_resources().get("CPU", 0))


def learner_gpus(config: RunConfig) -> int:
    """GPUs to reserve for the learner in the Ray cluster that this process has joined: 0 or 1.

    Raises:
      ConfigError: the config asks for CUDA, and the cluster has no GPU.
    """
    if config.device == "cpu":
        return 0
    resources = ray.cluster_resources() if config.device == "cuda" else ray.available_resources()
    have = resources.get("GPU", 0) >= 1
    require(have or config.device == "auto", "device is cuda, but the cluster has no GPU; give --device auto or cpu")
    return int(have)


def connect(cpus: int, address: str | None, spare_cpus: int = 0) -> None:
    """Joins the Ray cluster at `address`; if it is None, starts Ray on this machine with at least `cpus` CPU slots.

    Args:
      cpus: slots that must be there.
      address: of the cluster.
      spare_cpus: more slots of a Ray on this machine, for actors that wait.

    Raises:
      ConfigError: the cluster cannot be reached, refuses the token, or has too few CPUs.
    """
    if ray.is_initialized():
        return  # by an earlier attempt of this run
    guard_ray(address is not None)
    os.environ.setdefault("RAY_IGNORE_UNHANDLED_ERRORS", "1")  # from calls of nodes that have been replaced
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    options: dict[str, Any] = {"address": address, "runtime_env": {"env_vars": ONE_THREAD}}
    starting: AbstractContextManager[None] = nullcontext()
    if address is None:
        starting = lean_start()
        for name, value in ONE_THREAD.items():  # a runtime_env would start processes anew that Ray has ready
            os.environ.setdefault(name, value)
        options = {
            "address": "local",
            "include_dashboard": False,
            "num_cpus": max(cpus, os.cpu_count() or 1) + spare_cpus,
        }
        options["_system_config"] = LOCAL_RAY
        own = own_temp_folder()
        if own is not None:
            options["_temp_dir"] = str(own)
            _own_folders.append(own)
    try:
        with starting, _kept_from_children(signal.SIGHUP), _own_handler(signal.SIGTERM):
            ray.init(logging_level="ERROR", **options)
    except (ConnectionError, AuthenticationError) as error:
        raise ConfigError(
            f"no Ray cluster answers at {address!r}; start one with `ray start --head`, "
            f"or for one with tokens {TOKEN_HELP}"
        ) from error
    have = cluster_cpus()
    if have < cpus:
        leave()
        raise ConfigError(
            f"the run needs {cpus} CPUs (one each for a rollout worker, a shard actor and the learner), "
            f"the cluster has {have}: lower workers or replay_shards, or add nodes"
        )


@contextmanager
def _kept_from_children(number: int) -> Iterator[None]:
    """Blocks a signal in all processes that start in the `with` block; here it arrives afterwards.

    A terminal that closes hangs up on all of its processes at once. The driver then needs the others for a checkpoint.
    Ray itself does the same with Ctrl-C.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {number})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _own_handler(number: int) -> Iterator[None]:
    """Restores the handler of a signal after the `with` block: Ray sets one that ends the process with other codes.

    Where the signal would end this process at once, it raises Interrupted from then on, so that what is open is closed.
    """
    before = signal.getsignal(number)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(number, _interrupt if before in (signal.SIG_DFL, None) else before)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise Interrupted(number)


def leave() -> None:
    """Leaves the Ray cluster; a Ray that this process started ends with all of its processes.

    A worker process may hang for good while it exits after its raylet has gone, when Ray no longer looks after it. So
    all of them are killed.
    """
    raylets = [child for child in psutil.Process().children() if child.name() == RAYLET]
    workers = [process for raylet in raylets for process in raylet.children(recursive=True)]
    ray.shutdown()
    for process in workers:
        with suppress(psutil.NoSuchProcess):
            process.kill()
    while _own_folders:
        shutil.rmtree(_own_folders.pop(), ignore_errors=True)


def evaluate_in_tasks(
    specs: list[EnvSpec], candidate: Candidate, seeds: list[int], address: str | None
) -> list[EpisodeStats]:
    """Plays one episode per environment and seed in Ray tasks on all CPUs (see `evaluate_each` for errors).

    Where no cluster is named, a few episodes of the swarm are played in this process, before a Ray would have started.

    Returns:
      For each environment one entry per seed, in order.
    """
    if address is None and is_short(specs, len(seeds)):
        return [evaluate(spec, candidate, seeds) for spec in specs]
    return list(evaluate_each([(spec, candidate) for spec in specs], seeds, address))


def evaluate_each(
    work: Iterable[tuple[EnvSpec, Candidate]], seeds: list[int], address: str | None
) -> Iterator[EpisodeStats]:
    """Plays one episode per seed for each pair of an environment and who plays there, one pair after the other.

    All of it is played in Ray tasks on all CPUs (see `connect` for further errors), from one start of Ray.

    Yields:
      For each pair, as soon as it is played, one entry per seed, in order.

    Raises:
      RunFailed: a task fails again and again.
    """
    sent = dict[int, Ref[Candidate]]()
    with task_calls(address) as (calls, cpus):
        for spec, candidate in work:
            if id(candidate) not in sent:
                sent[id(candidate)] = calls.put(candidate)
            yield evaluate_in_parallel(calls, spec, sent[id(candidate)], seeds, cpus)


@contextmanager
def task_calls(address: str | None) -> Iterator[tuple[RayCalls, int]]:
    """Joins a cluster for tasks alone; gives their calls, and how many CPUs there are.

    Raises:
      ConfigError: see `connect`.
      RunFailed: a task fails again and again.
    """
    connect(1, address)
    try:
        yield RayCalls(DEADLINE_S), cluster_cpus()
    except CallFailed as failure:
        raise RunFailed(f"the evaluation {failure.fault} again and again: {failure.reason}") from failure
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

    def __init__(self, config: RunConfig, incarnation: int, options: ClusterOptions) -> None:
        has_shards = config.replay_placement == "actors"
        connect(cpus_needed(config), options.address, options.spares * (1 + has_shards))
        self._shape = env_shape(config.env)
        self._node_calls = RayCalls(options.deadline_s * INNER_SHARE)
        limits = Limits(
            deadline_s=options.deadline_s,
            start_deadline_s=options.start_deadline_s,
            collects_in_flight=COLLECTS_IN_FLIGHT,
            blocks_in_flight=config.workers * (COLLECTS_IN_FLIGHT + PUSHES_IN_FLIGHT),
            updates_in_flight=UPDATES_IN_FLIGHT,
            eval_tasks=cluster_cpus(),
            message_s=MESSAGE_S,
        )
        calls = RayCalls(max(options.deadline_s, options.start_deadline_s))
        self._spare_workers = Spares(options.spares, self._start_spare_worker)
        self._spare_shards = Spares(options.spares * has_shards, lambda: _start_actor(SpareShard, 0))
        super().__init__(config, incarnation, calls, limits)

    def place_learner(self) -> Handle[LearnerNode]:
        """Starts the learner's actor, which embeds the shards if they have no actors of their own."""
        arguments = (self.config, self._shape, self.shards, self._node_calls)
        return _start_actor(LearnerActor, learner_gpus(self.config), *arguments)

    def place_worker(self, worker_id: int, incarnation: int) -> Handle[RolloutNode]:
        """Starts the actor of a rollout worker, or makes a spare one."""
        arguments = (worker_id, incarnation, self._node_calls, self.targets, PUSHES_IN_FLIGHT)
        spare = self._spare_workers.take(*arguments)
        if spare is not None:
            return spare
        worker = _start_actor(RolloutNode, 0, rollout_settings(self.config), *arguments)
        self.calls.start(worker, RolloutNode.prepare, self._blank_weights())
        return worker

    def _blank_weights(self) -> WeightsSnapshot:
        config, shape = self.config, self._shape
        row_size = config.env.row_size if config.network == "pooled" else 0
        return blank_weights(shape.observation_size, config.policy_sizes, shape.num_actions, row_size)

    def _start_spare_worker(self) -> Handle[SpareWorker]:
        return _start_actor(SpareWorker, 0, rollout_settings(self.config), self._blank_weights())

    def place_shard(self, index: int, incarnation: int) -> Handle[ShardNode]:
        """Starts the actor of an empty shard, or makes a spare one."""
        settings = shard_settings(self.config, self._shape, incarnation)[index]
        return self._spare_shards.take(settings) or _start_actor(ShardNode, 0, settings)

    def keep_spares(self) -> None:
        """Starts the spares that are missing."""
        self._spare_workers.keep()
        self._spare_shards.keep()

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
        for spares in (self._spare_workers, self._spare_shards):
            spares.discard()

    def close(self) -> None:
        """Leaves the cluster (see `leave`)."""
        leave()


def _start_actor(kind: Callable[[*Ts], N], gpus: int, *args: *Ts) -> Handle[N]:
    """Starts `kind(*args)` as a Ray actor; Ray must not restart it, since it does not know the incarnation."""
    actor = ray.remote(num_cpus=1, num_gpus=gpus, max_restarts=0, max_task_retries=0)(kind)
    handle: Handle[N] = actor.remote(*args)
    return handle
