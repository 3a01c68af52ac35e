"""What runs in a process of its own, or with the learner: a replay shard with its replies.

A plain class, so that the same code runs in one process and as a Ray actor.
"""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.policy.network import WeightsSnapshot
from actors.replay.prioritised import PrioritisedShard, PrioritySettings
from actors.replay.shard import ReplayShard
from actors.service.messages import AddReply, Delivered, SampleReply, TransitionBlock
from actors.storage.fragment_writer import FragmentWriter, WriteResult
from actors.storage.malloc import limit_fragmentation
from actors.storage.uri import Location, fetched

REMEMBERED_BLOCKS = 8
"""Blocks of a worker that a shard knows one by one; more than may be under way at once."""


class ShardSettings(NamedTuple):
    """What a replay shard needs to know of the run; without `priorities` it draws uniformly."""

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
    """A replay shard that tells every worker of newer weights."""

    def __init__(self, settings: ShardSettings) -> None:
        limit_fragmentation()  # blocks come and go here
        self.shard = make_shard(settings)
        self._writer = FragmentWriter()
        self._weights: WeightsSnapshot | None = None
        self._known: dict[int, deque[tuple[int, int]]] = {}
        self._delivered: dict[int, tuple[int, Delivered]] = {}

    def publish(self, weights: WeightsSnapshot) -> None:
        """Hands out these weights from now on, in the replies themselves: a reference would cost a round trip more."""
        self._weights = weights

    def add(self, block: TransitionBlock) -> AddReply:
        """Stores a block; the reply carries newer weights than the block's, if there are any."""
        stored = self.shard.add(block)
        header = block.header
        known = self._known.setdefault(header.worker_id, deque(maxlen=REMEMBERED_BLOCKS))
        outdated = stored.duplicate and (header.incarnation, header.sequence) not in known
        if not stored.duplicate:
            known.append((header.incarnation, header.sequence))
            self._note_delivery(block)
        version = -1 if self._weights is None else self._weights.version
        newer = self._weights if version > header.policy_version else None
        return AddReply(stored.rows, stored.duplicate, version, newer, outdated)

    def _note_delivery(self, block: TransitionBlock) -> None:
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

    def set_priorities(self, numbers: NDArray[np.int64], td_errors: NDArray[np.float32]) -> float:
        """Takes the learner's answer to `sample`, see PrioritisedShard.set_priorities; returns the mass after it."""
        assert isinstance(self.shard, PrioritisedShard)
        self.shard.set_priorities(numbers, td_errors)
        return self.shard.mass

    def mass(self) -> float:
        """What the shard counts among all (see ReplayShard.mass)."""
        return self.shard.mass

    def size(self) -> int:
        """Transitions held."""
        return self.shard.size

    def save(self, location: Location) -> dict[str, Any]:
        """Starts to write what the shard holds now to a zarr group at `location`; `saved` tells of its end.

        Returns:
          The state that belongs to it, for JSON.
        """
        snapshot = self.shard.snapshot()
        if not self._writer.start(location, snapshot.save):
            snapshot.close()
        return self.shard.get_state()

    def saved(self, timeout_s: float = 0.0) -> WriteResult | None:
        """How the last `save` ended; None while it is still being written after `timeout_s`."""
        return self._writer.result(timeout_s)

    def load(self, location: Location, state: dict[str, Any]) -> None:
        """Takes up what `save` wrote and returned (see ReplayShard.load)."""
        with fetched(location) as path:
            self.shard.load(path, state)
