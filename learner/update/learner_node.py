"""What runs in the learner's process: sample, update, publish; and the shards that are embedded there."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from actors.policy.network import WeightsSnapshot
from actors.replay.node import ShardNode
from actors.service.fault_policy import CallFailed, Component, ComponentFailed, ComponentKind
from actors.service.messages import STORES, WAITS, AddReply, Delivered, Draws, SampleReply, TransitionBlock
from actors.service.rpc import Calls, Node, Ref
from actors.service.stopwatch import Stopwatch
from actors.storage.fragment_writer import FragmentWriter, WriteResult, join_results
from actors.storage.uri import Location, fetched, join_location
from learner.update.double_dqn import importance_weights
from learner.update.learner import Learner
from learner.update.prefetch import DrawAhead, DrawWhenAsked
from learner.update.updates import LearnerSettings, UpdateStats

SLOW_CALL_S = 3_600.0
SAMPLES, UPDATES, PUBLISHES = "samples", "updates", "publishes"
"""The learner waits for its shards' rows, makes updates of them, hands out TD errors and weights."""
WEIGHTS = "learner.safetensors"
"""File of networks and optimiser in a checkpoint."""


class UpdateReport(NamedTuple):
    """What a call of updates gives back: their means, and the version reached.

    `seconds` says where the learner's time went since its last report (see SAMPLES, UPDATES, PUBLISHES, STORES, WAITS).
    """

    stats: UpdateStats
    version: int
    seconds: dict[str, float]


class Sample(NamedTuple):
    """A super-batch: columns of transitions `[count, ...]`, and of prioritised ones also how they were drawn.

    `shard` `[count]` is the shard that each came from, None where there is one; `draws.probability` is among the rows
    of all shards.
    """

    columns: dict[str, NDArray[Any]]
    shard: NDArray[np.int64] | None
    draws: Draws | None


class LearnerNode:
    """The learner with its replay shards, in this process or elsewhere.

    Args:
      settings: see LearnerSettings.
      shards: nodes with `sample`, `set_priorities`, `publish`, `mass`, `save`, `saved`, `load`.
      shard_calls: how to call the shards.
      draws_ahead: whether the rows of the next call of updates are drawn during this one, in another thread.
    """

    def __init__(
        self, settings: LearnerSettings, shards: list[Node], shard_calls: Calls, draws_ahead: bool = False
    ) -> None:
        torch.set_num_threads(1)
        self._settings = settings
        self._learner = Learner(settings)
        self._shards = list(shards)
        self._shard_incarnations = [0] * len(shards)
        self._shard_calls = shard_calls
        self._rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence((settings.seed, 1))))
        self._masses = np.zeros(len(shards), np.float64)
        self._answers: dict[int, Ref] = {}
        self._samples = DrawAhead(self._sample) if draws_ahead else DrawWhenAsked(self._sample)
        self._writer = FragmentWriter()
        self._watch = Stopwatch()
        self.publish()

    def add(self, block: TransitionBlock) -> AddReply:
        """Stores a block in an embedded shard, each in turn."""
        self._watch.lap(WAITS)
        shard: ShardNode = self._shards[block.header.sequence % len(self._shards)]
        reply = shard.add(block)
        self._watch.lap(STORES)
        return reply

    def fence(self, worker_id: int, closed: int, incarnation: int) -> Delivered:
        """Fences a worker in all embedded shards (see `ShardNode.fence`); returns what they hold together."""
        parts: list[Delivered] = [shard.fence(worker_id, closed, incarnation) for shard in self._shards]
        rows, env_steps, episodes, made = zip(*parts, strict=True)
        return Delivered(sum(rows), sum(env_steps), sum(episodes), max(made))

    def replace_shard(self, index: int, shard: Node, incarnation: int) -> None:
        """Samples from `shard`, which is empty, in the place of the shard of this index."""
        self._shards[index], self._shard_incarnations[index] = shard, incarnation
        self._masses[index] = 0.0
        self._answers.pop(index, None)
        self._samples.drop()
        self._shard_calls.start(shard, "publish", self._weights)

    def _result(self, index: int, ref: Ref) -> Any:
        """What a call of the shard of this index gave.

        Raises:
          ComponentFailed: the shard failed; nothing has been learned meanwhile.
        """
        try:
            return self._shard_calls.get(ref)
        except CallFailed as failure:
            part = Component(ComponentKind.SHARD, index)
            raise ComponentFailed(part, self._shard_incarnations[index], failure.fault, failure.reason) from failure

    def _slow_result(self, index: int, ref: Ref) -> Any:
        """`_result` of a call that reads a whole shard; the caller's deadline is for all of them."""
        self._shard_calls.wait([ref], SLOW_CALL_S)
        return self._result(index, ref)

    def update(self, updates: int, learning_rate: float, importance_exponent: float = 1.0) -> UpdateReport:
        """Samples a super-batch, makes `updates` updates of it, and publishes the weights.

        Of prioritised shards the sample is weighted, and the TD errors go back to the shards that it came from.
        """
        self._watch.lap(WAITS)
        count = updates * self._settings.batch_size
        sample, weights = self._samples.take(count), None
        self._watch.lap(SAMPLES)
        if sample.draws is not None:
            weights = importance_weights(sample.draws.probability, self._settings.batch_size, importance_exponent)
        self._samples.begin(count)
        stats = self._learner.update(sample.columns, learning_rate, weights)
        self._watch.lap(UPDATES)
        if sample.draws is not None:
            self._answer(sample)
        self.publish()
        self._watch.lap(PUBLISHES)
        self._samples.settle()
        self._watch.lap(SAMPLES)
        return UpdateReport(stats, self._learner.updates, self._watch.take())

    def publish(self) -> None:
        """Shares the newest weights with all shards, whose replies carry them to the workers."""
        self._weights = self._learner.weights(time.time())
        for shard in self._shards:
            self._shard_calls.start(shard, "publish", self._weights)

    def _sample(self, count: int) -> Sample:
        """Draws rows from the shards in proportion to their masses, in random order."""
        self._take_answers()
        if len(self._shards) == 1:
            reply: SampleReply = self._result(0, self._shard_calls.start(self._shards[0], "sample", count))
            return Sample(reply.columns, None, reply.draws)
        if not self._masses.all():
            self._masses[:] = self._ask_all("mass")
        chances = self._masses / self._masses.sum()
        shares = self._rng.multinomial(count, chances)
        asked = np.flatnonzero(shares)  # a shard may still be empty
        refs = [self._shard_calls.start(self._shards[i], "sample", int(shares[i])) for i in asked]
        replies = [self._result(i, ref) for i, ref in zip(asked.tolist(), refs, strict=True)]
        self._masses[asked] = [reply.mass for reply in replies]
        order = self._rng.permutation(count)
        columns = {
            name: np.concatenate([reply.columns[name] for reply in replies])[order] for name in replies[0].columns
        }
        drawn = [(chances[i], reply.draws) for i, reply in zip(asked, replies, strict=True) if reply.draws is not None]
        if not drawn:
            return Sample(columns, None, None)
        number = np.concatenate([draws.insertion_index for _, draws in drawn])[order]
        probability = np.concatenate([chance * draws.probability for chance, draws in drawn])[order]
        return Sample(columns, np.repeat(asked, shares[asked])[order], Draws(number, probability))

    def _answer(self, sample: Sample) -> None:
        """Sends the TD errors of the updates to the shards that their rows came from."""
        assert sample.draws is not None
        for i in np.unique(sample.shard) if sample.shard is not None else [0]:
            mine = slice(None) if sample.shard is None else sample.shard == i
            answer = (sample.draws.insertion_index[mine], self._learner.td_errors[mine])
            self._answers[int(i)] = self._shard_calls.start(self._shards[i], "set_priorities", *answer)

    def _take_answers(self) -> None:
        """Waits until the shards have taken the last call's TD errors, which may have failed there."""
        while self._answers:
            i, ref = self._answers.popitem()
            self._masses[i] = self._result(i, ref)

    def _ask_all(self, method: str) -> list[Any]:
        refs = [self._shard_calls.start(shard, method) for shard in self._shards]
        return [self._result(i, ref) for i, ref in enumerate(refs)]

    def save(self, folder: Location) -> dict[str, Any]:
        """Starts to write learner and shards, as they are now, into `folder`; `saved` tells of its end.

        Returns:
          The rest of their state, for JSON.

        Raises:
          ComponentFailed: a shard failed.
        """
        self._take_answers()
        tensors = self._learner.get_state()
        self._writer.start(join_location(folder, WEIGHTS), lambda path: save_file(tensors, str(path)))
        refs = [
            self._shard_calls.start(shard, "save", _shard_folder(folder, i)) for i, shard in enumerate(self._shards)
        ]
        shards = [self._result(i, ref) for i, ref in enumerate(refs)]
        return {"shards": shards, "rng": self._rng.bit_generator.state, "sizes": self._masses.tolist()}

    def saved(self, timeout_s: float = 0.0) -> WriteResult | None:
        """How the last `save` ended, all shards included; None while something of it is being written.

        Args:
          timeout_s: how long to wait for each.

        Raises:
          ComponentFailed: a shard failed, and the others have written.
        """
        parts, failures = [self._writer.result(timeout_s)], []
        refs = [self._shard_calls.start(shard, "saved", timeout_s) for shard in self._shards]
        for i, ref in enumerate(refs):
            try:
                parts.append(self._result(i, ref))
            except ComponentFailed as failure:
                failures.append(failure)
        written = join_results(parts)
        if written is not None and failures:
            raise failures[0]
        return written

    def load(self, folder: Location, state: dict[str, Any]) -> None:
        """Takes up what `save` wrote and returned; publishes the weights (see `publish`).

        Raises:
          ValueError: the files are damaged or do not fit this run.
        """
        location = join_location(folder, WEIGHTS)
        try:
            with fetched(location) as path:
                self._learner.set_state(load_file(str(path)))
        except (SafetensorError, OSError, KeyError) as error:
            raise ValueError(f"{location} cannot be read ({error})") from error
        if len(state["shards"]) != len(self._shards):
            raise ValueError(f"the checkpoint has {len(state['shards'])} shards, this run {len(self._shards)}")
        refs = [
            self._shard_calls.start(shard, "load", _shard_folder(folder, i), shard_state)
            for i, (shard, shard_state) in enumerate(zip(self._shards, state["shards"], strict=True))
        ]
        for i, ref in enumerate(refs):
            self._slow_result(i, ref)
        self._rng.bit_generator.state = state["rng"]
        self._answers.clear()
        self._samples.drop()
        self._masses[:] = state["sizes"]
        self.publish()

    def weights(self) -> WeightsSnapshot:
        """The newest weights."""
        return self._weights


def _shard_folder(folder: Location, shard: int) -> Location:
    return join_location(folder, f"shard-{shard}.zarr")
