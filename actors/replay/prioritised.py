"""A replay shard with proportional prioritisation.

T. Schaul, J. Quan, I. Antonoglou, D. Silver, "Prioritized experience replay" (ICLR 2016), Section 3.3 and Algorithm 1.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.replay.shard import ReplayShard, ShardSnapshot
from actors.replay.sum_tree import SumTree
from actors.service.messages import Draws, SampleReply
from actors.service.packing import Packed
from actors.storage.ring_snapshot import RingSnapshot
from actors.storage.zarr_columns import load_rows, save_rows

PRIORITY_EPSILON = 1e-6
"""Added to every |TD error| (the paper's epsilon), so that every transition may be drawn again."""
PRIORITIES = "priorities"
"""Name of the zarr group of the saved priorities, within that of the rows."""
PRIORITY_DTYPE = np.dtype([("priority", np.float64)])
"""Structured dtype of the saved priorities."""


class PrioritySettings(NamedTuple):
    """Settings of prioritised sampling.

    `exponent` is the paper's alpha: 0 samples uniformly, 1 in proportion to |TD error|. `strata` is the number of
    strata per minibatch, the learner's batch size.
    """

    exponent: float
    strata: int


class PrioritisedSnapshot(ShardSnapshot):
    """A ShardSnapshot with priorities, which are saved to a zarr group within that of the rows.

    Args:
      rows, frames: see ShardSnapshot.
      priorities: copy of the priorities of the rows held `[size]`.
    """

    def __init__(self, rows: RingSnapshot, frames: RingSnapshot, priorities: NDArray[np.float64]) -> None:
        super().__init__(rows, frames)
        self._priorities = priorities

    def save(self, path: Path) -> None:
        """Writes rows, frames and priorities to a zarr group at `path`; may be called once."""
        super().save(path)
        save_rows(path / PRIORITIES, self._priorities.view(PRIORITY_DTYPE))


class PrioritisedShard(ReplayShard):
    """A replay shard that samples each row with a probability proportional to its priority.

    The priority is (|TD error| + PRIORITY_EPSILON) ** exponent. New rows get the maximum priority so far, so that each
    is soon drawn. Rows are identified by their insertion index, so that a priority update for an overwritten row is
    ignored.

    Args:
      dtype, capacity, seed: see ReplayShard.
      settings: see PrioritySettings.
    """

    def __init__(self, dtype: np.dtype[Any], capacity: int, seed: int, settings: PrioritySettings) -> None:
        super().__init__(dtype, capacity, seed)
        self._settings = settings
        self._tree = SumTree(capacity)
        self._max_priority = 1.0
        self._stale = 0

    @property
    def mass(self) -> float:
        """Weight of this shard when the learner chooses between shards: the sum of its priorities."""
        return self._tree.total

    @property
    def priorities(self) -> NDArray[np.float64]:
        """Priorities of the rows held, by slot `[size]` float64."""
        return self._tree.values[: self._size]

    def _write(self, packed: Packed) -> None:
        super()._write(packed)
        capacity = len(self._rows)
        count = min(len(packed.rows), capacity)
        start = (self._next - count) % capacity
        first = min(count, capacity - start)
        self._tree.fill(start, first, self._max_priority)
        self._tree.fill(0, count - first, self._max_priority)

    def sample(self, count: int) -> SampleReply:
        """Draws `count` rows in proportion to their priorities, stratified (see SumTree.stratified_sample).

        Raises:
          ValueError: the shard is empty.
        """
        self._refuse_if_empty()
        slots, priorities = self._tree.stratified_sample(self._rng.random(count), self._settings.strata)
        insertion_indices = self._inserted - 1 - (self._next - 1 - slots) % len(self._rows)
        return SampleReply(self._gather(slots), self.mass, Draws(insertion_indices, priorities / self.mass))

    def set_priorities(self, insertion_indices: NDArray[np.int64], td_errors: NDArray[np.float32]) -> None:
        """Updates the priorities of sampled rows; ignores and counts stale updates, whose rows have been overwritten.

        Args:
          insertion_indices: `[count]`, from Draws; if one occurs several times, its last TD error counts.
          td_errors: `[count]`, of any sign.

        Raises:
          ValueError: a TD error is not finite.
        """
        magnitude = np.abs(td_errors.astype(np.float64)) + PRIORITY_EPSILON
        if not np.isfinite(magnitude).all():
            raise ValueError(
                "TD errors are not finite, the learning has diverged: lower learning_rate or max_gradient_norm"
            )
        age = self._inserted - 1 - insertion_indices
        held = (age >= 0) & (age < self._size)
        self._stale += len(insertion_indices) - int(held.sum())
        priorities = magnitude[held] ** self._settings.exponent
        self._tree.set((self._next - 1 - age[held]) % len(self._rows), priorities)
        self._max_priority = max(self._max_priority, float(priorities.max(initial=0.0)))

    def get_state(self) -> dict[str, Any]:
        """As ReplayShard's, with the maximum priority and the number of stale updates."""
        return {**super().get_state(), "largest_priority": self._max_priority, "stale": self._stale}

    def snapshot(self) -> PrioritisedSnapshot:
        """As ReplayShard's; the priorities are copied at once, since later updates change them."""
        return PrioritisedSnapshot(*self._ring_snapshots(), self.priorities.copy())

    def load(self, path: Path, state: dict[str, Any]) -> None:
        """As ReplayShard's.

        Raises:
          ValueError: the saved rows or priorities do not fit this shard.
        """
        if "largest_priority" not in state:
            raise ValueError(f"{path} was saved without priorities (replay = uniform)")
        priorities = load_rows(path / PRIORITIES, PRIORITY_DTYPE, at_most=len(self._rows))["priority"]
        if len(priorities) != state["size"]:
            raise ValueError(f"{path / PRIORITIES} holds {len(priorities)} priorities for {state['size']} transitions")
        super().load(path, state)
        self._tree.load(priorities)
        self._max_priority, self._stale = state["largest_priority"], state["stale"]
