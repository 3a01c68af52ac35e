"""When to collect and when to learn: Reverb's sample-to-insert rule as a pure state machine.

A. Cassirer et al., "Reverb: a framework for experience replay" (2021), Section 3: with d = inserted x
samples_per_insert - sampled, sampling may lower d and inserting may raise it only within a band. The band
begins at min_replay x samples_per_insert and is as wide as two calls of updates and all blocks that may be
under way, for with a narrower one both sides would wait for each other.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from learner.config import RunConfig


class PacingState(NamedTuple):
    """Counters that a checkpoint holds; `written_off` are samples that lost transitions will not give."""

    inserted: int
    sampled: int
    waits_to_insert: int
    waits_to_sample: int
    written_off: float = 0.0


class Pacer:
    """Says how many blocks may be started and how many updates are due.

    Args:
      samples_per_insert: wanted ratio.
      min_replay: transitions that must be stored before the first update.
      batch_size: transitions per update.
      updates_per_call: updates that are started together.
      block_rows: transitions of one block.
      blocks_in_flight: blocks that may be under way at once.

    Raises:
      ValueError: an argument is not positive.
    """

    def __init__(
        self,
        samples_per_insert: float,
        min_replay: int,
        batch_size: int,
        updates_per_call: int,
        block_rows: int,
        blocks_in_flight: int,
    ) -> None:
        numbers = (samples_per_insert, min_replay, batch_size, updates_per_call, block_rows, blocks_in_flight)
        if min(numbers) <= 0:
            raise ValueError(f"pacing needs positive numbers, not {numbers}")
        self._samples_per_insert = samples_per_insert
        self._min_replay = min_replay
        self._batch_size = batch_size
        self._updates_per_call = updates_per_call
        self._block_rows = block_rows
        self._lowest = min_replay * samples_per_insert
        self._highest = (
            self._lowest + 2 * batch_size * updates_per_call + blocks_in_flight * block_rows * samples_per_insert
        )
        self.state = PacingState(0, 0, 0, 0)

    def may_collect(self, blocks_in_flight: int) -> bool:
        """Whether one more block may be started while `blocks_in_flight` are under way."""
        return self._ahead((blocks_in_flight + 1) * self._block_rows) <= self._highest

    def _ahead(self, expected: int = 0) -> float:
        """Samples that the transitions inserted, and `expected` ones, have still to give."""
        inserted, sampled = self.state.inserted + expected, self.state.sampled
        return inserted * self._samples_per_insert - sampled - self.state.written_off

    def updates_due(self) -> int:
        """Updates to start now: `updates_per_call` once the replay is ahead by as many, else 0."""
        if self.state.inserted < self._min_replay:
            return 0
        return self._updates_per_call if self._ahead() >= self._lowest else 0

    def inserted(self, rows: int) -> None:
        """Counts stored transitions."""
        self.state = self.state._replace(inserted=self.state.inserted + rows)

    def sampling(self, updates: int) -> None:
        """Counts the samples of updates that are being started."""
        self.state = self.state._replace(sampled=self.state.sampled + updates * self._batch_size)

    def not_sampled(self, updates: int) -> None:
        """Takes back the samples of updates that could not be made."""
        self.state = self.state._replace(sampled=self.state.sampled - updates * self._batch_size)

    def lost(self, share: float) -> None:
        """Writes off what a lost share of the replay had still to give, as if it had never been inserted.

        After the loss of all of it, `min_replay` transitions must come before the next update, as at the start; to
        sample new ones in the place of lost ones would break their ratio.
        """
        written_off = self.state.written_off + share * max(0.0, self._ahead())
        self.state = self.state._replace(written_off=written_off)

    def waited(self, to_insert: bool) -> None:
        """Counts a moment when only one side could go on; `to_insert` if it was the collecting that waited."""
        if to_insert:
            self.state = self.state._replace(waits_to_insert=self.state.waits_to_insert + 1)
        else:
            self.state = self.state._replace(waits_to_sample=self.state.waits_to_sample + 1)

    def ratio(self) -> float:
        """Samples per insert so far; nan before the first insert."""
        return self.state.sampled / self.state.inserted if self.state.inserted else math.nan


def make_pacer(config: RunConfig, blocks_in_flight: int) -> Pacer:
    """The pacer of a run whose workers have `blocks_in_flight` blocks under way together."""
    return Pacer(
        config.samples_per_insert,
        config.min_replay,
        config.batch_size,
        config.updates_per_call,
        config.block_env_steps,
        blocks_in_flight,
    )
