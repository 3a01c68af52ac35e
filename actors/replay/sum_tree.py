"""A sum tree: samples slots in proportion to their values in logarithmic time.

The tree is a heap of float64 sums: `tree[1]` is the root, `tree[n] = tree[2 n] + tree[2 n + 1]`, and the second half
holds the leaves. Whenever a child changes, its parent is computed again from both children, never by adding a
difference. So rounding errors do not accumulate, and the leaves determine every bit of the tree: a checkpoint stores
the leaves alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_core.jit import kernel


class SumTree:
    """Non-negative values of `capacity` slots, all zero at first.

    Args:
      capacity: number of slots.
    """

    def __init__(self, capacity: int) -> None:
        self._first_leaf = 1 << (capacity - 1).bit_length()
        self._tree = np.zeros(2 * self._first_leaf)
        self.values = self._tree[self._first_leaf : self._first_leaf + capacity]
        """Values `[capacity]` float64; read only."""

    @property
    def total(self) -> float:
        """Sum of all values."""
        return float(self._tree[1])

    def fill(self, start: int, count: int, value: float) -> None:
        """Sets the values of slots `start:start + count` to `value`."""
        self.values[start : start + count] = value
        self._refresh(start, count)

    def load(self, values: NDArray[np.float64]) -> None:
        """Sets the values of the first `len(values)` slots, and the others to zero."""
        self.values[: len(values)] = values
        self.values[len(values) :] = 0.0
        self._refresh(0, len(self.values))

    def _refresh(self, start: int, count: int) -> None:
        if count:
            _refresh_range(self._tree, self._first_leaf + start, self._first_leaf + start + count - 1)

    def set(self, slots: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Sets the values `[count]` of `slots` `[count]`; if a slot occurs several times, its last value counts."""
        _set(self._tree, slots + self._first_leaf, values)

    def stratified_sample(
        self, uniform: NDArray[np.float64], strata: int
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Samples slots in proportion to their values, stratified (Schaul et al. 2016, B.2.1).

        The draws form batches of `strata`; the last one may be smaller. A batch of k draws takes one from each of k
        equal ranges of the total.

        Args:
          uniform: random numbers in [0, 1), one per draw `[count]`.
          strata: draws per batch.

        Returns:
          (slots `[count]`, their values `[count]`); never a slot whose value is zero.
        """
        slots, values = np.empty(len(uniform), np.int64), np.empty(len(uniform))
        _stratified_sample(self._tree, uniform, strata, slots, values)
        return slots, values


@kernel
def _refresh_range(tree, low, high):
    """Recomputes all ancestors of the leaves `tree[low]` to `tree[high]`."""
    while low > 1:
        low, high = low // 2, high // 2
        for node in range(low, high + 1):
            tree[node] = tree[2 * node] + tree[2 * node + 1]


@kernel
def _set(tree, nodes, values):
    """Sets the leaves `nodes` and recomputes their ancestors level by level, shared ones once; overwrites `nodes`."""
    count = len(nodes)
    for i in range(count):
        tree[nodes[i]] = values[i]
    while count and nodes[0] > 1:
        kept = 0
        for i in range(count):
            node = nodes[i] // 2
            if kept == 0 or nodes[kept - 1] != node:
                tree[node] = tree[2 * node] + tree[2 * node + 1]
                nodes[kept] = node
                kept += 1
        count = kept


@kernel
def _stratified_sample(tree, uniform, strata, slots, values):
    """Descends one level for all draws at a time, so that the cache misses of different draws overlap."""
    first_leaf = len(tree) // 2
    count = len(uniform)
    for i in range(count):
        start = i // strata * strata
        values[i] = (i - start + uniform[i]) / min(strata, count - start) * tree[1]
        slots[i] = 1
    width = 1
    while width < first_leaf:
        for i in range(count):
            left, right = tree[2 * slots[i]], tree[2 * slots[i] + 1]
            # rounding must not lead into a subtree whose sum is zero
            goes_right = values[i] >= left and right > 0.0
            values[i] -= left if goes_right else 0.0
            slots[i] = 2 * slots[i] + (1 if goes_right else 0)
        width *= 2
    for i in range(count):
        values[i] = tree[slots[i]]
        slots[i] -= first_leaf
