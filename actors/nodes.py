"""What runs in a process of its own: a rollout worker with its pushes, a replay shard with its replies.

Plain classes over `Calls`, so that the same code runs in one process and as Ray actors. Experience goes
from a rollout worker straight to a shard; the reply carries newer weights, if there are any.
"""

from __future__ import annotations

import time
from collections import deque
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from actors.calls import Calls, Node, Ref
from actors.network import WeightsSnapshot
from actors.prioritised import PrioritisedShard, PrioritySettings
from actors.replay import ReplayShard
from actors.rollout import RolloutSettings, RolloutWorker
from actors.transitions import AddReply, BlockReport, SampleReply, TransitionBlock


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
        self.shard = make_shard(settings)
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

    def save(self, path: Path) -> dict[str, Any]:
        """Saves the shard (see ReplayShard.save)."""
        return self.shard.save(path)

    def load(self, path: Path, state: dict[str, Any]) -> None:
        """Loads the shard (see ReplayShard.load)."""
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

    def save(self, path: Path) -> dict[str, Any]:
        """Writes the worker's arrays to `path`; returns the rest of its state, for JSON.

        Raises:
          RuntimeError: pushes are under way.
        """
        if self._pushes:
            raise RuntimeError("settle before the state is saved: pushes are under way")
        saved = self._worker.get_state()
        save_file(saved["arrays"], str(path))
        return {**saved["meta"], "next_shard": self._next_shard}

    def load(self, path: Path, state: dict[str, Any]) -> None:
        """Takes up what `save` wrote and returned.

        Raises:
          ValueError: the file is damaged or does not fit.
        """
        try:
            arrays = load_file(str(path))
        except (SafetensorError, OSError) as error:
            raise ValueError(f"{path} cannot be read ({error})") from error
        self._next_shard = state["next_shard"] % len(self._shards)
        self._worker.set_state(arrays, state)
