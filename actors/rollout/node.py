"""The node of a rollout worker: it collects blocks and pushes them to the replay shards.

A plain class over `Calls`, which runs in this process or as a Ray actor. Transitions go straight from a rollout worker
to a shard; the shard's reply carries newer weights, if there are any.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from functools import cached_property
from typing import Any, NamedTuple, Protocol

from safetensors import SafetensorError
from safetensors.numpy import load_file
from safetensors.numpy import save as to_bytes

from actors.policy.policy import WeightsSnapshot
from actors.rollout.worker import RolloutSettings, RolloutWorker, rehearse
from actors.service.fault_policy import Action, CallFailed, ComponentKind, Fault, decide
from actors.service.messages import (
    ACTS,
    STORES,
    WAITS,
    AddReply,
    BlockReport,
    Delivered,
    Dropped,
    TransitionBlock,
)
from actors.service.rpc import Calls, Handle, Ref
from actors.service.stopwatch import Stopwatch
from actors.storage.fragment_writer import FragmentWriter, WriteResult
from actors.storage.uri import Location, fetched


class PushTarget(Protocol):
    """What rollout workers push to: a replay shard, or the learner with the shards that it embeds."""

    def add(self, block: TransitionBlock) -> AddReply:
        """Stores a block; the reply carries newer weights than the block's, if there are any."""
        ...

    def fence(self, worker_id: int, closed: int, incarnation: int) -> Delivered:
        """Refuses blocks of a worker from before `incarnation` from now on; returns what was stored of `closed`."""
        ...


class _Push(NamedTuple):
    """A push in flight: its block, the shard and the shard's incarnation, and the attempt number, from 1."""

    block: TransitionBlock
    shard: int
    incarnation: int
    attempt: int
    ref: Ref[AddReply]


def _report(push: _Push, reply: AddReply, dropped: Dropped | None) -> BlockReport:
    header = push.block.header
    return BlockReport(
        header=header,
        episodes=push.block.episodes,
        stored=reply.stored,
        staleness_updates=max(0, reply.weights_version - header.policy_version),
        staleness_s=time.time() - header.policy_time_s,
        rows=push.block.transitions,
        shard=push.shard,
        shard_incarnation=push.incarnation,
        dropped=dropped,
    )


class RolloutNode:
    """A rollout worker that pushes its blocks to the shards in turn.

    Pushes may be in flight while the next block is collected; a block is reported once it is stored.

    Args:
      settings: see RolloutSettings.
      worker_id: position among the workers; the first push goes to the shard `worker_id` modulo their number.
      incarnation: distinguishes the starts of this worker; grows with each.
      calls: how to call the shards.
      shards: where to push to.
      pushes_in_flight: most pushes that are in flight when `collect` returns.
    """

    def __init__(
        self,
        settings: RolloutSettings,
        worker_id: int,
        incarnation: int,
        calls: Calls,
        shards: Sequence[Handle[PushTarget]],
        pushes_in_flight: int,
    ) -> None:
        self._origin = settings, worker_id, incarnation
        self._calls = calls
        self._shards = list(shards)
        self._shard_incarnations = [0] * len(shards)
        self._next_shard = worker_id % len(shards)
        self._limit = pushes_in_flight
        self._writer = FragmentWriter()
        self._pushes: deque[_Push] = deque()
        self._watch = Stopwatch()

    @cached_property
    def _worker(self) -> RolloutWorker:
        """Made in the first call that needs it: what is wrong with a user's environment comes out as that call's error.

        Of an error while an actor is made, Ray would keep the text alone.
        """
        return RolloutWorker(*self._origin)

    def prepare(self, blank: WeightsSnapshot) -> None:
        """Makes the worker and loads the simulator's code while other nodes still start; nobody needs the answer.

        Args:
          blank: any weights of the policy's shape.
        """
        with suppress(Exception):  # the first call that needs the worker raises it again
            if self._worker and self._origin[0].env.is_swarm:
                rehearse(self._origin[0], blank)

    def replace_shard(self, index: int, shard: Handle[PushTarget], incarnation: int) -> None:
        """Pushes to `shard`, of this incarnation, in place of the shard of this index."""
        self._shards[index], self._shard_incarnations[index] = shard, incarnation

    def set_weights(self, weights: WeightsSnapshot) -> None:
        """Acts with these weights from the next block on."""
        self._worker.set_weights(weights)

    def collect(self, rate: float) -> list[BlockReport]:
        """Collects one block with exploration rate `rate` and pushes it.

        Returns:
          Reports of the blocks that have been stored or dropped since the last report.

        Raises:
          CallFailed: no weights have arrived; they were lost on the way.
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
        ref = self._calls.start(self._shards[shard], PushTarget.add, block)
        return _Push(block, shard, self._shard_incarnations[shard], attempt, ref)

    def close(self) -> None:
        """Closes the worker's environments."""
        self._worker.close()

    def settle(self) -> list[BlockReport]:
        """Waits for every push in flight; returns their reports."""
        self._watch.lap(WAITS)
        reports = self._confirm(0)
        self._watch.lap(STORES)
        return reports

    def _confirm(self, limit: int) -> list[BlockReport]:
        reports = []
        while len(self._pushes) > limit:
            reports.append(self._completed(self._pushes.popleft()))
        return reports

    def _completed(self, push: _Push) -> BlockReport:
        """Waits for a push and retries it where the fault allows that: the shard recognises duplicates."""
        while True:
            try:
                reply = self._calls.get(push.ref)
            except CallFailed as failure:
                if decide(ComponentKind.SHARD, failure.fault, push.attempt, 0.0) is not Action.RETRY:
                    return _report(push, AddReply(0, False, -1, None), Dropped.SHARD_LOST)._replace(fault=failure.fault)
                push = self._push(push.block, push.shard, push.attempt + 1)
                continue
            self._take_weights(reply)
            if not reply.duplicate:
                return _report(push, reply, None)
            if push.attempt > 1 and not reply.outdated:  # an earlier attempt stored it
                return _report(push, reply._replace(stored=push.block.transitions), None)
            return _report(push, reply, Dropped.OUTDATED if reply.outdated else Dropped.DUPLICATE)

    def _take_weights(self, reply: AddReply) -> None:
        if reply.weights is not None and reply.weights_version > self._worker.policy_version:
            self._worker.set_weights(reply.weights)

    def save(self, location: Location) -> dict[str, Any]:
        """Starts to write the worker's arrays, as they are now, to the file `location`; `saved` tells how that ended.

        Returns:
          The rest of its state, for JSON.

        Raises:
          RuntimeError: pushes are in flight.
        """
        if self._pushes:
            raise RuntimeError("pushes are in flight; settle before the state is saved")
        state = self._worker.get_state()
        self._writer.start(location, lambda path: path.write_bytes(to_bytes(state["arrays"])))
        return {**state["meta"], "next_shard": self._next_shard}

    def saved(self, timeout_s: float = 0.0) -> WriteResult | None:
        """How the last `save` ended; None while it is still being written after `timeout_s`."""
        return self._writer.result(timeout_s)

    def load(self, location: Location, state: dict[str, Any]) -> None:
        """Restores what `save` wrote and returned.

        Raises:
          ValueError: the file is damaged or does not fit this worker.
        """
        try:
            with fetched(location) as path:
                arrays = load_file(str(path))
        except (SafetensorError, OSError) as error:
            raise ValueError(f"{location} cannot be read ({error})") from error
        self._next_shard = state["next_shard"] % len(self._shards)
        self._worker.set_state(arrays, state)
