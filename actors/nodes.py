"""What runs in a process of its own: a rollout worker with its pushes, a replay shard with its replies.

Plain classes over `Calls`, so that the same code runs in one process and as Ray actors. Experience goes
from a rollout worker straight to a shard; the reply carries newer weights, if there are any.
"""

from __future__ import annotations

import time
from collections import deque
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from actors.calls import Calls, Node, Ref
from actors.locations import Location, fetched
from actors.network import WeightsSnapshot
from actors.parts import PartWriter, Written
from actors.replay import ReplayShard
from actors.rollout import RolloutSettings, RolloutWorker
from actors.storage import save_rows
from actors.transitions import AddReply, BlockReport, SampleReply, TransitionBlock


class ShardSettings(NamedTuple):
    """What a replay shard needs to know of the run."""

    dtype: np.dtype[Any]
    capacity: int
    seed: int


class ShardNode:
    """A replay shard that tells every worker of newer weights."""

    def __init__(self, settings: ShardSettings) -> None:
        self.shard = ReplayShard(*settings)
        self._writer = PartWriter()
        self._version = -1
        self._weights: Ref = None

    def publish(self, version: int, weights: list[Ref]) -> None:
        """Hands out `weights[0]`, a reference in a list so that it travels as one, from now on."""
        self._version, self._weights = version, weights[0]

    def add(self, block: TransitionBlock) -> AddReply:
        """Stores a block; the reply carries newer weights than the block's, if there are any."""
        stored = self.shard.add(block)
        newer = self._version > block.header.policy_version
        return AddReply(stored.rows, stored.duplicate, self._version, self._weights if newer else None)

    def sample(self, count: int) -> SampleReply:
        """Draws `count` rows."""
        return self.shard.sample(count)

    def size(self) -> int:
        """Transitions held."""
        return self.shard.size

    def save(self, location: Location) -> dict[str, Any]:
        """Starts to write the shard's rows as they are now to a zarr group at `location`; `saved` tells of its end.

        Returns:
          The state that belongs to them, for JSON.
        """
        rows = self.shard.snapshot()

        def write(path: Path) -> None:
            with closing(rows):
                save_rows(path, rows)

        self._writer.start(location, write)
        return self.shard.get_state()

    def saved(self) -> Written | None:
        """How the last `save` ended; None while it is being written."""
        return self._writer.result()

    def load(self, location: Location, state: dict[str, Any]) -> None:
        """Takes up what `save` wrote and returned (see ReplayShard.load)."""
        with fetched(location) as path:
            self.shard.load(path, state)


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
        self._shards = shards
        self._next_shard = worker_id % len(shards)
        self._limit = pushes_in_flight
        self._writer = PartWriter()
        self._pushes: deque[tuple[TransitionBlock, Ref]] = deque()

    def set_weights(self, weights: WeightsSnapshot) -> None:
        """Acts with these weights."""
        self._worker.set_weights(weights)

    def collect(self, rate: float) -> list[BlockReport]:
        """Collects one block with exploration rate `rate` and pushes it.

        Returns:
          Reports of the blocks that were stored meanwhile.
        """
        block = self._worker.collect(rate)
        shard = self._shards[self._next_shard]
        self._next_shard = (self._next_shard + 1) % len(self._shards)
        self._pushes.append((block, self._calls.start(shard, "add", block)))
        return self._confirm(self._limit)

    def settle(self) -> list[BlockReport]:
        """Waits for every push under way; returns their reports."""
        return self._confirm(0)

    def _confirm(self, limit: int) -> list[BlockReport]:
        reports = []
        while len(self._pushes) > limit:
            block, ref = self._pushes.popleft()
            reports.append(self._report(block, self._calls.get(ref)))
        return reports

    def _report(self, block: TransitionBlock, reply: AddReply) -> BlockReport:
        if reply.weights is not None and reply.weights_version > self._worker.policy_version:
            self._worker.set_weights(self._calls.get(reply.weights))
        return BlockReport(
            header=block.header,
            episodes=block.episodes,
            stored=reply.stored,
            staleness_updates=max(0, reply.weights_version - block.header.policy_version),
            staleness_s=time.time() - block.header.policy_time_s,
        )

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
