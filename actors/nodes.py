"""What runs in a process of its own: a rollout worker with its pushes, a replay shard with its replies.

Plain classes over `Calls`, so that the same code runs in one process and as Ray actors. Experience goes
from a rollout worker straight to a shard; the reply carries newer weights, if there are any.
"""

from __future__ import annotations

import time
from collections import deque
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from actors.calls import Calls, Node, Ref
from actors.faults import Action, CallFailed, Fault, PartKind, decide
from actors.locations import Location, fetched
from actors.memory import keep_large_apart
from actors.network import WeightsSnapshot
from actors.parts import PartWriter, Written
from actors.prioritised import PrioritisedShard, PrioritySettings
from actors.replay import ReplayShard
from actors.rollout import RolloutSettings, RolloutWorker
from actors.stopwatch import Stopwatch
from actors.transitions import (
    ACTS,
    STORES,
    WAITS,
    AddReply,
    BlockReport,
    Delivered,
    Dropped,
    SampleReply,
    TransitionBlock,
)

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
        keep_large_apart()  # blocks come and go here
        self.shard = make_shard(settings)
        self._writer = PartWriter()
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
            before.rows + len(block.rows),
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

    def saved(self) -> Written | None:
        """How the last `save` ended; None while it is being written."""
        return self._writer.result()

    def load(self, location: Location, state: dict[str, Any]) -> None:
        """Takes up what `save` wrote and returned (see ReplayShard.load)."""
        with fetched(location) as path:
            self.shard.load(path, state)


class _Push(NamedTuple):
    """A push under way: which block to which incarnation of which shard, and the how manieth attempt it is."""

    block: TransitionBlock
    shard: int
    incarnation: int
    attempt: int
    ref: Ref


def _report(push: _Push, reply: AddReply, dropped: Dropped | None) -> BlockReport:
    header = push.block.header
    return BlockReport(
        header=header,
        episodes=push.block.episodes,
        stored=reply.stored,
        staleness_updates=max(0, reply.weights_version - header.policy_version),
        staleness_s=time.time() - header.policy_time_s,
        rows=len(push.block.rows),
        shard=push.shard,
        shard_incarnation=push.incarnation,
        dropped=dropped,
    )


class RolloutNode:
    """A rollout worker that pushes its blocks to the shards in turn.

    A push may still be under way while the next block is collected; a block is reported once it is stored.

    Args:
      settings: see RolloutSettings.
      worker_id: position among the workers; also the first shard that is pushed to.
      incarnation: how often this worker was started before.
      calls: how to call the shards.
      shards: nodes with `add`.
      pushes_in_flight: pushes that may be under way when `collect` returns.
    """

    def __init__(
        self,
        settings: RolloutSettings,
        worker_id: int,
        incarnation: int,
        calls: Calls,
        shards: list[Node],
        pushes_in_flight: int,
    ) -> None:
        self._worker = RolloutWorker(settings, worker_id, incarnation)
        self._calls = calls
        self._shards = list(shards)
        self._shard_incarnations = [0] * len(shards)
        self._next_shard = worker_id % len(shards)
        self._limit = pushes_in_flight
        self._writer = PartWriter()
        self._pushes: deque[_Push] = deque()
        self._watch = Stopwatch()

    def replace_shard(self, index: int, shard: Node, incarnation: int) -> None:
        """Pushes to `shard` from now on where it pushed to the shard of this index."""
        self._shards[index], self._shard_incarnations[index] = shard, incarnation

    def set_weights(self, weights: WeightsSnapshot) -> None:
        """Acts with these weights."""
        self._worker.set_weights(weights)

    def collect(self, rate: float) -> list[BlockReport]:
        """Collects one block with exploration rate `rate` and pushes it.

        Returns:
          Reports of the blocks that were stored, or dropped, meanwhile.

        Raises:
          CallFailed: it never got weights, for they were lost on their way.
        """
        if self._worker.policy_version < 0:
            raise CallFailed(Fault.OBJECT_LOST, "it has no weights")
        self._watch.lap(WAITS)
        block = self._worker.collect(rate)
        self._watch.lap(ACTS)
        shard = self._next_shard
        self._next_shard = (self._next_shard + 1) % len(self._shards)
        self._pushes.append(self._push(block, shard, 1))
        reports = self._confirm(self._limit)
        self._watch.lap(STORES)
        if reports:
            reports[-1] = reports[-1]._replace(seconds=self._watch.take())
        return reports

    def _push(self, block: TransitionBlock, shard: int, attempt: int) -> _Push:
        ref = self._calls.start(self._shards[shard], "add", block)
        return _Push(block, shard, self._shard_incarnations[shard], attempt, ref)

    def settle(self) -> list[BlockReport]:
        """Waits for every push under way; returns their reports."""
        self._watch.lap(WAITS)
        reports = self._confirm(0)
        self._watch.lap(STORES)
        return reports

    def _confirm(self, limit: int) -> list[BlockReport]:
        reports = []
        while len(self._pushes) > limit:
            reports.append(self._settled(self._pushes.popleft()))
        return reports

    def _settled(self, push: _Push) -> BlockReport:
        """Waits for a push, which is tried again where that is harmless: the shard knows the blocks it has."""
        while True:
            try:
                reply: AddReply = self._calls.get(push.ref)
            except CallFailed as failure:
                if decide(PartKind.SHARD, failure.fault, push.attempt, 0.0) is not Action.RETRY:
                    return _report(push, AddReply(0, False, -1, None), Dropped.SHARD_LOST)._replace(fault=failure.fault)
                push = self._push(push.block, push.shard, push.attempt + 1)
                continue
            self._take_weights(reply)
            if not reply.duplicate:
                return _report(push, reply, None)
            if push.attempt > 1 and not reply.outdated:  # an attempt before had stored it
                return _report(push, reply._replace(stored=len(push.block.rows)), None)
            return _report(push, reply, Dropped.OUTDATED if reply.outdated else Dropped.DUPLICATE)

    def _take_weights(self, reply: AddReply) -> None:
        if reply.weights is not None and reply.weights_version > self._worker.policy_version:
            self._worker.set_weights(reply.weights)

    def save(self, location: Location) -> dict[str, Any]:
        """Starts to write the worker's arrays as they are now to the file `location`; `saved` tells of its end.

        Returns:
          The rest of its state, for JSON.

        Raises:
          RuntimeError: pushes are under way.
        """
        if self._pushes:
            raise RuntimeError("settle before the state is saved: pushes are under way")
        state = self._worker.get_state()
        self._writer.start(location, lambda path: save_file(state["arrays"], str(path)))
        return {**state["meta"], "next_shard": self._next_shard}

    def saved(self) -> Written | None:
        """How the last `save` ended; None while it is being written."""
        return self._writer.result()

    def load(self, location: Location, state: dict[str, Any]) -> None:
        """Takes up what `save` wrote and returned.

        Raises:
          ValueError: the file is damaged or does not fit.
        """
        try:
            with fetched(location) as path:
                arrays = load_file(str(path))
        except (SafetensorError, OSError) as error:
            raise ValueError(f"{location} cannot be read ({error})") from error
        self._next_shard = state["next_shard"] % len(self._shards)
        self._worker.set_state(arrays, state)
