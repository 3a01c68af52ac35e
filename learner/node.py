"""What runs in the learner's process: sample, update, publish; and the shards that are embedded there."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from actors.calls import Calls, Node, Ref
from actors.locations import Location, fetched, inside
from actors.nodes import ShardNode
from actors.parts import PartWriter, Written, join_written
from actors.transitions import AddReply, SampleReply, TransitionBlock
from learner.learner import Learner, LearnerSettings, UpdateStats

WEIGHTS = "learner.safetensors"
"""File of networks and optimiser in a checkpoint."""


class UpdateReport(NamedTuple):
    """What a call of updates gives back: their means, the version reached, and a reference to the weights."""

    stats: UpdateStats
    version: int
    weights: list[Ref]


class LearnerNode:
    """The learner with its replay shards, in this process or elsewhere.

    Args:
      settings: see LearnerSettings.
      shards: nodes with `sample`, `publish`, `size`, `save`, `saved`, `load`.
      shard_calls: how to call the shards.
      calls: how to share weights with rollout workers.
    """

    def __init__(self, settings: LearnerSettings, shards: list[Node], shard_calls: Calls, calls: Calls) -> None:
        torch.set_num_threads(1)
        self._settings = settings
        self._learner = Learner(settings)
        self._shards = shards
        self._shard_calls = shard_calls
        self._calls = calls
        self._rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence((settings.seed, 1))))
        self._sizes = np.zeros(len(shards), np.float64)
        self._weights: Ref = None
        self._writer = PartWriter()
        self.publish()

    def add(self, block: TransitionBlock) -> AddReply:
        """Stores a block in an embedded shard, each in turn."""
        shard: ShardNode = self._shards[block.header.sequence % len(self._shards)]
        return shard.add(block)

    def update(self, updates: int, learning_rate: float) -> UpdateReport:
        """Samples a super-batch, makes `updates` updates of it, and publishes the weights."""
        rows = self._sample(updates * self._settings.batch_size)
        stats = self._learner.update(rows, learning_rate)
        return UpdateReport(stats, self._learner.updates, self.publish())

    def publish(self) -> list[Ref]:
        """Shares the newest weights with all shards, whose replies carry them to the workers.

        Returns:
          A reference to the WeightsSnapshot, in a list so that it travels as a reference.
        """
        self._weights = self._calls.put(self._learner.weights(time.time()))
        for shard in self._shards:
            self._shard_calls.start(shard, "publish", self._learner.updates, [self._weights])
        return [self._weights]

    def _sample(self, count: int) -> NDArray[Any]:
        """Draws rows from the shards in proportion to their sizes, in random order."""
        if len(self._shards) == 1:
            reply: SampleReply = self._shard_calls.get(self._shard_calls.start(self._shards[0], "sample", count))
            return reply.rows
        if not self._sizes.all():
            self._sizes[:] = self._ask_all("size")
        shares = self._rng.multinomial(count, self._sizes / self._sizes.sum())
        asked = np.flatnonzero(shares)  # a shard may still be empty
        refs = [self._shard_calls.start(self._shards[i], "sample", int(shares[i])) for i in asked]
        replies = [self._shard_calls.get(ref) for ref in refs]
        self._sizes[asked] = [reply.size for reply in replies]
        return self._rng.permutation(np.concatenate([reply.rows for reply in replies]))

    def _ask_all(self, method: str) -> list[Any]:
        refs = [self._shard_calls.start(shard, method) for shard in self._shards]
        return [self._shard_calls.get(ref) for ref in refs]

    def save(self, folder: Location) -> dict[str, Any]:
        """Starts to write learner and shards, as they are now, into `folder`; `saved` tells of its end.

        Returns:
          The rest of their state, for JSON.
        """
        tensors = self._learner.get_state()
        self._writer.start(inside(folder, WEIGHTS), lambda path: save_file(tensors, str(path)))
        refs = [
            self._shard_calls.start(shard, "save", inside(folder, f"shard-{i}.zarr"))
            for i, shard in enumerate(self._shards)
        ]
        shards = [self._shard_calls.get(ref) for ref in refs]
        return {"shards": shards, "rng": self._rng.bit_generator.state, "sizes": self._sizes.tolist()}

    def saved(self) -> Written | None:
        """How the last `save` ended, all shards included; None while something of it is being written."""
        own = self._writer.result()
        return None if own is None else join_written([own, *self._ask_all("saved")])

    def load(self, folder: Location, state: dict[str, Any]) -> list[Ref]:
        """Takes up what `save` wrote and returned; publishes the weights (see `publish`).

        Raises:
          ValueError: the files are damaged or do not fit this run.
        """
        location = inside(folder, WEIGHTS)
        try:
            with fetched(location) as path:
                self._learner.set_state(load_file(str(path)))
        except (SafetensorError, OSError, KeyError) as error:
            raise ValueError(f"{location} cannot be read ({error})") from error
        if len(state["shards"]) != len(self._shards):
            raise ValueError(f"the checkpoint has {len(state['shards'])} shards, this run {len(self._shards)}")
        refs = [
            self._shard_calls.start(shard, "load", inside(folder, f"shard-{i}.zarr"), shard_state)
            for i, (shard, shard_state) in enumerate(zip(self._shards, state["shards"], strict=True))
        ]
        for ref in refs:
            self._shard_calls.get(ref)
        self._rng.bit_generator.state = state["rng"]
        self._sizes[:] = state["sizes"]
        return self.publish()

    def weights(self) -> list[Ref]:
        """A reference to the newest weights, in a list."""
        return [self._weights]
