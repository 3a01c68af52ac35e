"""What runs in a process of its own: a rollout worker with its pushes.

A plain class over `Calls`, so that the same code runs in one process and as a Ray actor. Experience goes
from a rollout worker straight to a shard; the reply carries newer weights, if there are any.
"""

from __future__ import annotations

import time
from collections import deque
from typing import Any, NamedTuple

from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from actors.policy.network import WeightsSnapshot
from actors.rollout.worker import RolloutSettings, RolloutWorker
from actors.service.fault_policy import Action, CallFailed, ComponentKind, Fault, decide
from actors.service.messages import (
    ACTS,
    STORES,
    WAITS,
    AddReply,
    BlockReport,
    Dropped,
    TransitionBlock,
)
from actors.service.rpc import Calls, Node, Ref
from actors.service.stopwatch import Stopwatch
from actors.storage.fragment_writer import FragmentWriter, WriteResult
from actors.storage.uri import Location, fetched


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
        rows=push.block.transitions,
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
        self._writer = FragmentWriter()
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
                if decide(ComponentKind.SHARD, failure.fault, push.attempt, 0.0) is not Action.RETRY:
                    return _report(push, AddReply(0, False, -1, None), Dropped.SHARD_LOST)._replace(fault=failure.fault)
                push = self._push(push.block, push.shard, push.attempt + 1)
                continue
            self._take_weights(reply)
            if not reply.duplicate:
                return _report(push, reply, None)
            if push.attempt > 1 and not reply.outdated:  # an attempt before had stored it
                return _report(push, reply._replace(stored=push.block.transitions), None)
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

    def saved(self, timeout_s: float = 0.0) -> WriteResult | None:
        """How the last `save` ended; None while it is still being written after `timeout_s`."""
        return self._writer.result(timeout_s)

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
