"""Warm spares: actors that have loaded code and kernels, and wait to take the place of one that is lost.

A new process spends seconds on imports and on loading compiled kernels before it does anything. A spare has done that,
and has rehearsed the work of its kind. It holds no part of the run until `begin` makes it one.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

import ray
from ray.exceptions import RayError

from actors.policy.policy import WeightsSnapshot
from actors.replay.node import ShardNode, ShardSettings
from actors.rollout.node import PushTarget, RolloutNode
from actors.rollout.worker import RolloutSettings, rehearse
from actors.service.rpc import Calls, Handle

N = TypeVar("N")

MOST_FAILURES = 3
"""Spares that may fail to start, one after the other, before no more are started."""


class Spare:
    """What every spare can do."""

    def is_ready(self) -> bool:
        """True, once it can be asked."""
        return True

    def take_name(self, kind: type[Any]) -> None:
        """Names this object's class as `kind` is named, which the title of its process then shows."""
        self.__class__ = type(kind.__name__, (type(self),), {})


class SpareWorker(Spare, RolloutNode):
    """A spare of the rollout workers.

    Args:
      settings: of the workers.
      blank: any weights of the policy's shape, for the rehearsal.
    """

    def __init__(self, settings: RolloutSettings, blank: WeightsSnapshot) -> None:
        self._settings = settings
        rehearse(settings, blank)

    def begin(
        self,
        worker_id: int,
        incarnation: int,
        calls: Calls,
        shards: Sequence[Handle[PushTarget]],
        pushes_in_flight: int,
    ) -> None:
        """Becomes a rollout worker (see RolloutNode)."""
        RolloutNode.__init__(self, self._settings, worker_id, incarnation, calls, shards, pushes_in_flight)
        self.take_name(RolloutNode)


class SpareShard(Spare, ShardNode):
    """A spare of the replay shards."""

    def __init__(self) -> None:
        """Loads nothing more than its modules; a shard's kernels are few."""

    def begin(self, settings: ShardSettings) -> None:
        """Becomes an empty shard (see ShardNode)."""
        ShardNode.__init__(self, settings)
        self.take_name(ShardNode)


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
        self._failures = 0

    def keep(self) -> None:
        """Starts what is missing; where the cluster has no free CPU slot, Ray starts it once there is one.

        After `MOST_FAILURES` that could not start, one after the other, it says so and starts no more.
        """
        for pair in self._ready():
            if _is_alive(pair[1]):
                self._failures = 0
            else:
                self._waiting.remove(pair)
                self._failures += 1
                if self._failures == MOST_FAILURES:
                    logging.getLogger(__name__).warning(
                        "%d spares could not start, one after the other; the run goes on without", MOST_FAILURES
                    )
        while len(self._waiting) < self._count and self._failures < MOST_FAILURES:
            spare: Any = self._start()
            self._waiting.append((spare, spare.is_ready.remote()))

    def take(self, *arguments: Any) -> Handle[N] | None:
        """A spare that has begun with `arguments`; None if there is none that is ready."""
        for pair in self._ready():
            self._waiting.remove(pair)
            if _is_alive(pair[1]):
                pair[0].begin.remote(*arguments)
                handle: Handle[N] = pair[0]
                return handle
        return None

    def _ready(self) -> list[tuple[Any, Any]]:
        """Those whose start has ended, well or not."""
        refs = [ref for _, ref in self._waiting]
        ready = set(ray.wait(refs, num_returns=len(refs), timeout=0)[0]) if refs else set()
        return [pair for pair in self._waiting if pair[1] in ready]

    def discard(self) -> None:
        """Kills them."""
        while self._waiting:
            ray.kill(self._waiting.pop()[0])


def _is_alive(ready: Any) -> bool:
    """Whether a spare has started, by its answer to `is_ready`."""
    try:
        return bool(ray.get(ready))
    except RayError:
        return False
