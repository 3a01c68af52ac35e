"""When to collect and when to learn: Reverb's rate limiter as a pure state machine.

A. Cassirer et al., "Reverb: a framework for experience replay" (2021), Section 3. With diff = inserted x
samples_per_insert - sampled, a call of updates starts only if diff is at least min_diff, and a block is collected only
if it leaves diff at most max_diff. Here min_diff is min_replay x samples_per_insert; max_diff is two calls of updates
and all blocks in flight above it, because in a narrower band both sides would wait for each other.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from learner.config import RunConfig


class PacingState(NamedTuple):
    """Counters that a checkpoint holds; `written_off` counts samples that lost transitions can no longer give."""

    inserted: int
    sampled: int
    waits_to_insert: int
    waits_to_sample: int
    written_off: float = 0.0


class Pacer:
    """Decides whether a block may be collected and how many updates are due.

    Args:
      samples_per_insert: the ratio to keep.
      min_replay: transitions that must be stored before the first update.
      batch_size: transitions per update.
      updates_per_call: updates that are started together.
      block_rows: transitions per block.
      blocks_in_flight: most blocks in flight at once.

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
        self._min_diff = min_replay * samples_per_insert
        self._max_diff = (
            self._min_diff + 2 * batch_size * updates_per_call + blocks_in_flight * block_rows * samples_per_insert
        )
        self.state = PacingState(0, 0, 0, 0)

    def may_collect(self, blocks_in_flight: int) -> bool:
        """Whether one more block may be collected while `blocks_in_flight` are in flight."""
        return self._diff((blocks_in_flight + 1) * self._block_rows) <= self._max_diff

    def _diff(self, expected: int = 0) -> float:
        """Samples that are still owed by the transitions inserted so far and by `expected` more."""
        inserted, sampled = self.state.inserted + expected, self.state.sampled
        return inserted * self._samples_per_insert - sampled - self.state.written_off

    def updates_due(self, calls: int = 1) -> int:
        """Updates to start now, those of as many calls as may start one after the other; 0 if sampling has to wait.

        Args:
          calls: the most.
        """
        ahead = self._diff() - self._min_diff
        if self.state.inserted < self._min_replay or ahead < 0:
            return 0
        due = 1 + int(ahead // (self._batch_size * self._updates_per_call))
        return min(calls, due) * self._updates_per_call

    def record_insert(self, rows: int) -> None:
        """Counts stored transitions."""
        self.state = self.state._replace(inserted=self.state.inserted + rows)

    def record_sample(self, updates: int) -> None:
        """Counts the samples of updates that are being started."""
        self.state = self.state._replace(sampled=self.state.sampled + updates * self._batch_size)

    def undo_sample(self, updates: int) -> None:
        """Takes back the samples of updates that failed."""
        self.state = self.state._replace(sampled=self.state.sampled - updates * self._batch_size)

    def write_off(self, share: float) -> None:
        """Writes off the samples that a lost share of the replay still owed, as if it had never been inserted.

        Sampling new transitions in place of lost ones would break the ratio of the new ones. After the loss of the
        whole replay, `min_replay` transitions must be inserted before the next update, as at the start.
        """
        written_off = self.state.written_off + share * max(0.0, self._diff())
        self.state = self.state._replace(written_off=written_off)

    def record_wait(self, to_insert: bool) -> None:
        """Counts a moment when one side had to wait: collecting if `to_insert`, else the updates."""
        if to_insert:
            self.state = self.state._replace(waits_to_insert=self.state.waits_to_insert + 1)
        else:
            self.state = self.state._replace(waits_to_sample=self.state.waits_to_sample + 1)

    def ratio(self) -> float:
        """Samples per insert so far; NaN before the first insert."""
        return self.state.sampled / self.state.inserted if self.state.inserted else math.nan


def make_pacer(config: RunConfig, blocks_in_flight: int) -> Pacer:
    """The pacer of a run; `blocks_in_flight` counts the blocks of all workers."""
    return Pacer(
        config.samples_per_insert,
        config.min_replay,
        config.batch_size,
        config.updates_per_call,
        config.block_env_steps,
        blocks_in_flight,
    )
