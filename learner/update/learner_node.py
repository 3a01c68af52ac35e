"""The node of the learner: it samples, updates, publishes weights, and may embed the replay shards."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError

from actors.policy.baselines import Baseline, MethodRule
from actors.policy.policy import WeightsSnapshot
from actors.replay.node import ShardNode
from actors.rollout.vector_env import EnvShape
from actors.service.fault_policy import CallFailed, Component, ComponentFailed, ComponentKind, Diverged
from actors.service.messages import STORES, WAITS, AddReply, Delivered, Draws, TransitionBlock
from actors.service.rpc import Calls, Handle, Ref
from actors.service.stopwatch import Stopwatch
from actors.storage.fragment_writer import FragmentWriter, WriteResult, join_results
from actors.storage.uri import Location, fetched, join_location
from learner.config import RunConfig
from learner.update.augmentation import RandomTurns
from learner.update.importance import importance_weights
from learner.update.prefetch import NoPrefetch, Prefetch
from learner.update.stats import UpdateStats

T = TypeVar("T")

LOAD_TIMEOUT_S = 3_600.0
"""Most time that a shard may take to load its rows; whoever loads the learner has a deadline of its own."""
SAMPLES, UPDATES, PUBLISHES = "samples", "updates", "publishes"
"""What the learner's time goes to, besides STORES and WAITS: rows to sample, updates, TD errors and weights to send."""
WEIGHTS = "learner.safetensors"
"""File of networks and optimiser in a checkpoint."""


class UpdateReport(NamedTuple):
    """Result of a call of `LearnerNode.update`: means over its updates, and the version of the weights that it reached.

    `seconds` says where the learner's time went since its last report (see SAMPLES, UPDATES, PUBLISHES, STORES, WAITS).
    """

    stats: UpdateStats
    version: int
    seconds: dict[str, float]


class Sample(NamedTuple):
    """A super-batch: the minibatches of one call of updates, one after the other.

    `columns` are those of the transitions `[count, ...]`. `shard` `[count]` is the index of the shard that each row
    came from, None if there is only one. `draws` tells how prioritised rows were drawn, with probabilities among the
    rows of all shards; None if all rows are drawn alike.
    """

    columns: dict[str, NDArray[Any]]
    shard: NDArray[np.int64] | None
    draws: Draws | None


class LearnerNode:
    """The learner with its replay shards, which it embeds or which are nodes of their own.

    Args:
      config: the run.
      shape: spaces of its environment.
      shards: where to sample from.
      calls: how to call the shards.
      prefetch: whether the rows of the next call of updates are drawn during this one (see `Prefetch`).
    """

    def __init__(
        self,
        config: RunConfig,
        shape: EnvShape,
        shards: Sequence[Handle[ShardNode]],
        calls: Calls,
        prefetch: bool = False,
    ) -> None:
        from learner.update.learner import Learner  # here, since the driver knows this class and needs no torch

        self._batch_size = config.batch_size
        self._learner = Learner(config, shape)
        self._shards = list(shards)
        self._shard_incarnations = [0] * len(shards)
        self._calls = calls
        self._rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence((config.seed, 1))))
        self._augment = RandomTurns(config) if config.random_turns else None
        self._teacher = None if config.teacher == "none" else MethodRule(config.world, Baseline(config.teacher))
        self._masses = np.zeros(len(shards), np.float64)
        self._priority_updates: dict[int, Ref[float]] = {}
        self._samples = Prefetch(self._draw) if prefetch else NoPrefetch(self._draw)
        self._writer = FragmentWriter()
        self._watch = Stopwatch()
        self.publish()

    def add(self, block: TransitionBlock) -> AddReply:
        """Stores a block in one of the embedded shards, in turn (see `PushTarget`)."""
        self._watch.lap(WAITS)
        shard = self._shards[block.header.sequence % len(self._shards)]
        reply = self._calls.get(self._calls.start(shard, ShardNode.add, block))
        self._watch.lap(STORES)
        return reply

    def fence(self, worker_id: int, closed: int, incarnation: int) -> Delivered:
        """Fences a worker in all embedded shards; returns what they have stored together (see `PushTarget`)."""
        refs = [self._calls.start(shard, ShardNode.fence, worker_id, closed, incarnation) for shard in self._shards]
        rows, env_steps, episodes, made = zip(*map(self._calls.get, refs), strict=True)
        return Delivered(sum(rows), sum(env_steps), sum(episodes), max(made))

    def replace_shard(self, index: int, shard: Handle[ShardNode], incarnation: int) -> None:
        """Samples from `shard`, which is empty and of this incarnation, in place of the shard of this index."""
        self._shards[index], self._shard_incarnations[index] = shard, incarnation
        self._masses[index] = 0.0
        self._priority_updates.pop(index, None)
        self._samples.drop()
        self._calls.start(shard, ShardNode.publish, self._weights)

    def _result(self, index: int, ref: Ref[T]) -> T:
        """The result of a call of the shard of this index.

        Raises:
          ComponentFailed: the shard failed.
        """
        try:
            return self._calls.get(ref)
        except CallFailed as failure:
            raise failure.of(Component(ComponentKind.SHARD, index), self._shard_incarnations[index]) from failure

    def update(
        self, updates: int, learning_rate: float, importance_exponent: float = 1.0, teacher_weight: float = 0.0
    ) -> UpdateReport:
        """Samples a super-batch, makes `updates` updates of it, and publishes the weights.

        With prioritised shards, the sample is weighted and its TD errors go back to the shards that it came from.

        Args:
          updates: how many, one minibatch each.
          learning_rate: Adam's.
          importance_exponent: beta of the importance weights (prioritised shards only).
          teacher_weight: of the losses of the teacher's actions (with a teacher only).

        Raises:
          ComponentFailed: a shard failed, and no update was made.
          Diverged: the loss or a weight is no longer finite; the weights are not published.
        """
        self._watch.lap(WAITS)
        count = updates * self._batch_size
        sample, weights = self._samples.take(count), None
        self._watch.lap(SAMPLES)
        if sample.draws is not None:
            weights = importance_weights(sample.draws.probability, self._batch_size, importance_exponent)
        self._samples.begin(count)
        if self._teacher is not None:
            sample.columns["teacher_weight"] = np.full(count, teacher_weight, np.float32)
        stats = self._learner.update(sample.columns, learning_rate, weights)
        self._check_finite(stats)
        self._watch.lap(UPDATES)
        if sample.draws is not None:
            self._update_priorities(sample)
        self.publish()
        self._watch.lap(PUBLISHES)
        self._samples.settle()
        self._watch.lap(SAMPLES)
        return UpdateReport(stats, self._learner.updates, self._watch.take())

    def publish(self) -> None:
        """Sends the newest weights to all shards, whose replies to pushes carry them on to the rollout workers.

        Raises:
          Diverged: a weight is not finite.
        """
        weights = self._learner.weights(time.time())
        if not all(np.isfinite(array).all() for array in weights.arrays):
            raise self._diverged("a weight is not finite")
        self._weights = weights
        for shard in self._shards:
            self._calls.start(shard, ShardNode.publish, self._weights)

    def _check_finite(self, stats: UpdateStats) -> None:
        """Raises Diverged if a mean over the updates is not finite; looking at them costs nothing."""
        for name, value in stats._asdict().items():
            if not math.isfinite(value):
                raise self._diverged(f"{name} is {value}")

    def _diverged(self, what: str) -> Diverged:
        return Diverged(f"{what} after {self._learner.updates:,} updates")

    def _draw(self, count: int) -> Sample:
        """Draws `count` rows (see `_sample`), augments them, and asks the teacher what it would have done."""
        sample = self._sample(count)
        columns = sample.columns if self._augment is None else self._augment(sample.columns, self._rng)
        if self._teacher is not None:
            columns = columns | {"teacher": self._teacher.act(columns["observation"])}
        return sample._replace(columns=columns)

    def _sample(self, count: int) -> Sample:
        """Draws `count` rows from the shards in proportion to their masses, in random order."""
        self._await_priority_updates()
        if len(self._shards) == 1:
            reply = self._result(0, self._calls.start(self._shards[0], ShardNode.sample, count))
            return Sample(reply.columns, None, reply.draws)
        if not self._masses.all():
            masses = [self._calls.start(shard, ShardNode.mass) for shard in self._shards]
            self._masses[:] = [self._result(i, ref) for i, ref in enumerate(masses)]
        chances = self._masses / self._masses.sum()
        shares = self._rng.multinomial(count, chances)
        drawn = np.flatnonzero(shares)  # a shard may still be empty
        refs = [self._calls.start(self._shards[i], ShardNode.sample, int(shares[i])) for i in drawn]
        replies = [self._result(i, ref) for i, ref in zip(drawn.tolist(), refs, strict=True)]
        self._masses[drawn] = [reply.mass for reply in replies]
        order = self._rng.permutation(count)
        columns = {
            name: np.concatenate([reply.columns[name] for reply in replies])[order] for name in replies[0].columns
        }
        draws = [(chances[i], reply.draws) for i, reply in zip(drawn, replies, strict=True) if reply.draws is not None]
        if not draws:
            return Sample(columns, None, None)
        index = np.concatenate([each.insertion_index for _, each in draws])[order]
        probability = np.concatenate([chance * each.probability for chance, each in draws])[order]
        return Sample(columns, np.repeat(drawn, shares[drawn])[order], Draws(index, probability))

    def _update_priorities(self, sample: Sample) -> None:
        """Sends the TD errors of the updates to the shards that their rows came from."""
        assert sample.draws is not None
        for i in np.unique(sample.shard) if sample.shard is not None else [0]:
            rows = slice(None) if sample.shard is None else sample.shard == i
            indices, td_errors = sample.draws.insertion_index[rows], self._learner.td_errors[rows]
            ref = self._calls.start(self._shards[i], ShardNode.set_priorities, indices, td_errors)
            self._priority_updates[int(i)] = ref

    def _await_priority_updates(self) -> None:
        """Waits until the shards have set the last call's priorities.

        Raises:
          ComponentFailed: a shard has not.
        """
        while self._priority_updates:
            i, ref = self._priority_updates.popitem()
            self._masses[i] = self._result(i, ref)

    def save(self, location: Location) -> dict[str, Any]:
        """Starts to write learner and shards, as they are now, to the folder `location`; `saved` tells how that ended.

        Returns:
          The rest of their state, for JSON.

        Raises:
          ComponentFailed: a shard failed.
          Diverged: a number of networks or optimiser is not finite; nothing is written.
        """
        self._await_priority_updates()
        try:
            write = self._learner.state_writer()
        except FloatingPointError as error:
            raise self._diverged(str(error)) from error
        self._writer.start(join_location(location, WEIGHTS), write)
        refs = [
            self._calls.start(shard, ShardNode.save, _shard_folder(location, i)) for i, shard in enumerate(self._shards)
        ]
        shards = [self._result(i, ref) for i, ref in enumerate(refs)]
        return {"shards": shards, "rng": self._rng.bit_generator.state, "sizes": self._masses.tolist()}

    def saved(self, timeout_s: float = 0.0) -> WriteResult | None:
        """How the last `save` ended, shards included; None while any fragment of it is still being written.

        Args:
          timeout_s: how long to wait for each fragment.

        Raises:
          ComponentFailed: a shard failed, and all others have ended their writing.
        """
        results, failures = [self._writer.result(timeout_s)], []
        refs = [self._calls.start(shard, ShardNode.saved, timeout_s) for shard in self._shards]
        for i, ref in enumerate(refs):
            try:
                results.append(self._result(i, ref))
            except ComponentFailed as failure:
                failures.append(failure)
        written = join_results(results)
        if written is not None and failures:
            raise failures[0]
        return written

    def load(self, location: Location, state: dict[str, Any]) -> None:
        """Restores what `save` wrote and returned, and publishes the weights.

        Raises:
          ValueError: the files are damaged or do not fit this run.
          ComponentFailed: a shard failed.
        """
        file = join_location(location, WEIGHTS)
        try:
            with fetched(file) as path:
                self._learner.read_state(path)
        except (SafetensorError, OSError, KeyError) as error:
            raise ValueError(f"{file} cannot be read ({error})") from error
        if len(state["shards"]) != len(self._shards):
            raise ValueError(f"the checkpoint has {len(state['shards'])} shards, this run {len(self._shards)}")
        refs = [
            self._calls.start(shard, ShardNode.load, _shard_folder(location, i), shard_state)
            for i, (shard, shard_state) in enumerate(zip(self._shards, state["shards"], strict=True))
        ]
        for i, ref in enumerate(refs):
            self._calls.wait([ref], LOAD_TIMEOUT_S)
            self._result(i, ref)
        self._rng.bit_generator.state = state["rng"]
        self._priority_updates.clear()
        self._samples.drop()
        self._masses[:] = state["sizes"]
        self.publish()

    def weights(self) -> WeightsSnapshot:
        """The newest weights."""
        return self._weights


def _shard_folder(location: Location, shard: int) -> Location:
    return join_location(location, f"shard-{shard}.zarr")
