"""Warm spares: actors that have loaded code and kernels, and wait to take the place of one that is lost.

A new process spends seconds on imports and on loading compiled kernels before it does anything. A spare has done that,
and has rehearsed the work of its kind. It holds no part of the run until `begin` makes it one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Generic, TypeVar

import ray
from ray.exceptions import RayError

from actors.policy.policy import WeightsSnapshot
from actors.replay.node import ShardNode, ShardSettings
from actors.rollout.node import PushTarget, RolloutNode
from actors.rollout.worker import RolloutSettings, RolloutWorker
from actors.service.rpc import Calls, Handle

N = TypeVar("N")


class SpareWorker(RolloutNode):
    """A spare of the rollout workers.

    Args:
      settings: of the workers.
      weights: any, for the rehearsal.
    """

    def __init__(self, settings: RolloutSettings, weights: WeightsSnapshot) -> None:
        self._settings = settings
        rehearsal = RolloutWorker(settings, 0, 0)
        rehearsal.set_weights(weights)
        rehearsal.collect(0.0)

    def is_ready(self) -> bool:
        """True, once it can be asked."""
        return True

    def begin(
        self,
        worker_id: int,
        incarnation: int,
        calls: Calls,
        shards: Sequence[Handle[PushTarget]],
        pushes_in_flight: int,
    ) -> None:
        """Becomes a rollout worker (see RolloutNode)."""
        super().__init__(self._settings, worker_id, incarnation, calls, shards, pushes_in_flight)


class SpareShard(ShardNode):
    """A spare of the replay shards."""

    def __init__(self) -> None:
        """Loads nothing more than its modules; a shard's kernels are few."""

    def is_ready(self) -> bool:
        """True, once it can be asked."""
        return True

    def begin(self, settings: ShardSettings) -> None:
        """Becomes an empty shard (see ShardNode)."""
        super().__init__(settings)


class Spares(Generic[N]):
    """The spares of one kind.

    Args:
      count: how many to keep.
      start: starts the actor of one.
    """

    def __init__(self, count: int, start: Callable[[], Handle[N]]) -> None:
        self._count = count
        self._start = start
        self._waiting: list[tuple[Any, Any]] = []

    def keep(self) -> None:
        """Starts what is missing; where the cluster has no free CPU slot, Ray starts it once there is one."""
        while len(self._waiting) < self._count:
            spare: Any = self._start()
            self._waiting.append((spare, spare.is_ready.remote()))

    def take(self, *arguments: Any) -> Handle[N] | None:
        """A spare that has begun with `arguments`; None if there is none that is ready."""
        ready, _ = ray.wait([ref for _, ref in self._waiting], timeout=0) if self._waiting else ([], [])
        for spare, ref in [pair for pair in self._waiting if pair[1] in ready]:
            self._waiting.remove((spare, ref))
            with suppress(RayError):  # it has died meanwhile
                ray.get(ref)
                spare.begin.remote(*arguments)
                handle: Handle[N] = spare
                return handle
        return None

    def discard(self) -> None:
        """Kills them."""
        while self._waiting:
            ray.kill(self._waiting.pop()[0])
