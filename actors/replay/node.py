"""The node of a replay shard: it stores blocks, hands out newer weights in its replies, and draws samples.

A plain class, which runs in the learner's process or as a Ray actor.
"""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.policy.policy import WeightsSnapshot
from actors.replay.prioritised import PrioritisedShard, PrioritySettings
from actors.replay.shard import ReplayShard
from actors.service.messages import AddReply, Delivered, SampleReply, TransitionBlock
from actors.storage.fragment_writer import FragmentWriter, WriteResult
from actors.storage.malloc import limit_fragmentation
from actors.storage.uri import Location, fetched

REMEMBERED_BLOCKS = 8
"""Newest blocks of a worker that a shard knows one by one; more than can be in flight at once."""


class ShardSettings(NamedTuple):
    """A replay shard's settings; without `priorities` it draws uniformly."""

    dtype: np.dtype[Any]
    capacity: int
    seed: int
    priorities: PrioritySettings | None = None


def make_shard(settings: ShardSettings) -> ReplayShard:
    """The shard that the settings describe."""
    dtype, capacity, seed, priorities = settings
    if priorities is None:
        return ReplayShard(dtype, capacity, seed)
    return PrioritisedShard(dtype, capacity, seed, priorities)


class ShardNode:
    """A replay shard whose replies carry newer weights to the workers; implements `actors.rollout.node.PushTarget`."""

    def __init__(self, settings: ShardSettings) -> None:
        limit_fragmentation()  # blocks are allocated and freed here all the time
        self.shard = make_shard(settings)
        self._writer = FragmentWriter()
        self._weights: WeightsSnapshot | None = None
        self._known: dict[int, deque[tuple[int, int]]] = {}
        self._delivered: dict[int, tuple[int, Delivered]] = {}

    def publish(self, weights: WeightsSnapshot) -> None:
        """Hands out these weights from now on, by value: a reference would cost the worker one more round trip."""
        self._weights = weights

    def add(self, block: TransitionBlock) -> AddReply:
        """Stores a block; the reply carries newer weights than the block's, if there are any."""
        stored = self.shard.add(block)
        header = block.header
        known = self._known.setdefault(header.worker_id, deque(maxlen=REMEMBERED_BLOCKS))
        outdated = stored.duplicate and (header.incarnation, header.sequence) not in known
        if not stored.duplicate:
            known.append((header.incarnation, header.sequence))
            self._record_delivery(block)
        version = -1 if self._weights is None else self._weights.version
        newer = self._weights if version > header.policy_version else None
        return AddReply(stored.rows, stored.duplicate, version, newer, outdated)

    def _record_delivery(self, block: TransitionBlock) -> None:
        header = block.header
        before = self._delivered_by(header.worker_id, header.incarnation)
        now = Delivered(
            before.rows + block.transitions,
            before.env_steps + header.env_steps,
            before.episodes + len(block.episodes.outcome),
            max(before.made, header.made),
        )
        self._delivered[header.worker_id] = (header.incarnation, now)

    def _delivered_by(self, worker_id: int, incarnation: int) -> Delivered:
        known, delivered = self._delivered.get(worker_id, (incarnation, Delivered()))
        return delivered if known == incarnation else Delivered()

    def fence(self, worker_id: int, closed: int, incarnation: int) -> Delivered:
        """Refuses blocks of a worker from before `incarnation` from now on; returns what was stored of `closed`."""
        self.shard.fence(worker_id, incarnation)
        return self._delivered_by(worker_id, closed)

    def sample(self, count: int) -> SampleReply:
        """Draws `count` rows."""
        return self.shard.sample(count)

    def set_priorities(self, insertion_indices: NDArray[np.int64], td_errors: NDArray[np.float32]) -> float:
        """Sets the priorities of sampled rows (see PrioritisedShard.set_priorities); returns the shard's new mass.

        Args:
          insertion_indices: `Draws.insertion_index` of the rows, `[count]`.
          td_errors: `[count]`.
        """
        assert isinstance(self.shard, PrioritisedShard)
        self.shard.set_priorities(insertion_indices, td_errors)
        return self.shard.mass

    def mass(self) -> float:
        """The shard's weight in a draw from all shards (see ReplayShard.mass)."""
        return self.shard.mass

    def size(self) -> int:
        """Transitions held."""
        return self.shard.size

    def save(self, location: Location) -> dict[str, Any]:
        """Starts to write what the shard holds now to a zarr group at `location`; `saved` tells how that ended.

        Returns:
          The rest of its state, for JSON.
        """
        snapshot = self.shard.snapshot()
        if not self._writer.start(location, snapshot.save):
            snapshot.close()
        return self.shard.get_state()

    def saved(self, timeout_s: float = 0.0) -> WriteResult | None:
        """How the last `save` ended; None while it is still being written after `timeout_s`."""
        return self._writer.result(timeout_s)

    def load(self, location: Location, state: dict[str, Any]) -> None:
        """Restores what `save` wrote and returned (see ReplayShard.load)."""
        with fetched(location) as path:
            self.shard.load(path, state)
