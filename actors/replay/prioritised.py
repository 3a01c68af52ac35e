"""A replay shard that draws transitions in proportion to what they may teach: proportional prioritised replay.

T. Schaul, J. Quan, I. Antonoglou, D. Silver, "Prioritized experience replay" (ICLR 2016), Algorithm 1.
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

SMALLEST = 1e-6
"""Added to every |TD error| (the paper's epsilon), so that no transition is never drawn again."""
PRIORITIES = "priorities"
"""Name of the saved priorities' group."""
SAVED = np.dtype([("priority", np.float64)])
"""Layout of the saved priorities."""


class PrioritySettings(NamedTuple):
    """How a shard prioritises.

    `exponent` is the paper's alpha: 0 draws uniformly, 1 in proportion to |TD error|. Draws are stratified in
    parts of `strata`, the learner's minibatch.
    """

    exponent: float
    strata: int


class PrioritisedSnapshot(ShardSnapshot):
    """As ShardSnapshot; the priorities lie in a zarr group of their own within that of the rows.

    Args:
      rows, frames: see ShardSnapshot.
      priorities: a copy of the rows' `[size]`.
    """

    def __init__(self, rows: RingSnapshot, frames: RingSnapshot, priorities: NDArray[np.float64]) -> None:
        super().__init__(rows, frames)
        self._priorities = priorities

    def save(self, path: Path) -> None:
        """Writes rows, frames and priorities to `path`, once."""
        super().save(path)
        save_rows(path / PRIORITIES, self._priorities.view(SAVED))


class PrioritisedShard(ReplayShard):
    """A replay shard with a priority (|TD error| + SMALLEST) ** exponent beside every row.

    New rows get the largest priority so far, so that each is soon drawn. A row is known by its number among all
    that were inserted: an answer about one that has been overwritten since finds nothing.

    Args:
      dtype, capacity, seed: see ReplayShard.
      settings: see PrioritySettings.
    """

    def __init__(self, dtype: np.dtype[Any], capacity: int, seed: int, settings: PrioritySettings) -> None:
        super().__init__(dtype, capacity, seed)
        self._settings = settings
        self._tree = SumTree(capacity)
        self._largest = 1.0
        self._stale = 0

    @property
    def mass(self) -> float:
        """What this shard counts when one of several is drawn: the sum of its priorities."""
        return self._tree.total

    @property
    def stale(self) -> int:
        """New priorities that came too late: their rows were overwritten."""
        return self._stale

    @property
    def priorities(self) -> NDArray[np.float64]:
        """Priorities of the rows held, `[size]`, by slot."""
        return self._tree.values[: self._size]

    def _write(self, packed: Packed) -> None:
        super()._write(packed)
        capacity = len(self._rows)
        count = min(len(packed.rows), capacity)
        start = (self._next - count) % capacity
        first = min(count, capacity - start)
        self._tree.fill(start, first, self._largest)
        self._tree.fill(0, count - first, self._largest)

    def sample(self, count: int) -> SampleReply:
        """Draws `count` rows in proportion to their priorities, stratified (see SumTree.find).

        Raises:
          ValueError: the shard is empty.
        """
        self._refuse_if_empty()
        slots, priorities = self._tree.find(self._rng.random(count), self._settings.strata)
        numbers = self._inserted - 1 - (self._next - 1 - slots) % len(self._rows)
        return SampleReply(self._take(slots), self.mass, Draws(numbers, priorities / self.mass))

    def set_priorities(self, numbers: NDArray[np.int64], td_errors: NDArray[np.float32]) -> None:
        """Gives rows that were drawn new priorities; those that have been overwritten are left out and counted.

        Args:
          numbers: `[count]` of Draws; of one that comes twice the last TD error counts.
          td_errors: `[count]`, of any sign.

        Raises:
          ValueError: a TD error is no finite number.
        """
        size = np.abs(td_errors.astype(np.float64)) + SMALLEST
        if not np.isfinite(size).all():
            raise ValueError(
                "TD errors are no finite numbers, the learning has diverged: lower learning_rate or max_gradient_norm"
            )
        age = self._inserted - 1 - numbers
        held = (age >= 0) & (age < self._size)
        self._stale += len(numbers) - int(held.sum())
        priorities = size[held] ** self._settings.exponent
        self._tree.put((self._next - 1 - age[held]) % len(self._rows), priorities)
        self._largest = max(self._largest, float(priorities.max(initial=0.0)))

    def get_state(self) -> dict[str, Any]:
        """As ReplayShard's, with what is behind the priorities of rows to come."""
        return {**super().get_state(), "largest_priority": self._largest, "stale": self._stale}

    def snapshot(self) -> PrioritisedSnapshot:
        """As ReplayShard's; priorities are copied at once, for answers to come change them."""
        return PrioritisedSnapshot(*self._ring_snapshots(), self.priorities.copy())

    def load(self, path: Path, state: dict[str, Any]) -> None:
        """As ReplayShard's.

        Raises:
          ValueError: the saved rows or priorities do not fit this shard.
        """
        if "largest_priority" not in state:
            raise ValueError(f"{path} was saved without priorities (replay = uniform)")
        priorities = load_rows(path / PRIORITIES, SAVED, at_most=len(self._rows))["priority"]
        if len(priorities) != state["size"]:
            raise ValueError(f"{path / PRIORITIES} holds {len(priorities)} priorities for {state['size']} transitions")
        super().load(path, state)
        self._tree.load(priorities)
        self._largest, self._stale = state["largest_priority"], state["stale"]
