"""A sum tree: positive numbers of which one is drawn in proportion to its size in logarithmic time.

A heap of float64 sums, `tree[1]` the root, `tree[n] = tree[2 n] + tree[2 n + 1]`, the leaves in its second half. Every
sum is computed from its two parts whenever one of them changes and never by differences, so that nothing drifts and
the leaves alone decide every bit of the tree: a checkpoint need hold no more than them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_core.jit import kernel


class SumTree:
    """`capacity` numbers, zero at first.

    Args:
      capacity: how many.
    """

    def __init__(self, capacity: int) -> None:
        self._first_leaf = 1 << (capacity - 1).bit_length()
        self._tree = np.zeros(2 * self._first_leaf)
        self.values = self._tree[self._first_leaf : self._first_leaf + capacity]
        """The numbers `[capacity]` float64, to read."""

    @property
    def total(self) -> float:
        """Their sum."""
        return float(self._tree[1])

    def fill(self, start: int, count: int, value: float) -> None:
        """Sets the numbers `start` to `start + count - 1`."""
        self.values[start : start + count] = value
        self._refresh(start, count)

    def load(self, values: NDArray[np.float64]) -> None:
        """Sets the first `len(values)` numbers and leaves zero behind them."""
        self.values[: len(values)] = values
        self.values[len(values) :] = 0.0
        self._refresh(0, len(self.values))

    def _refresh(self, start: int, count: int) -> None:
        if count:
            _refresh_range(self._tree, self._first_leaf + start, self._first_leaf + start + count - 1)

    def put(self, slots: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Sets the numbers at `slots` `[count]`; of a slot that comes twice the last value stays."""
        _put(self._tree, slots + self._first_leaf, values)

    def find(self, uniform: NDArray[np.float64], strata: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Draws in proportion to the numbers, stratified.

        Args:
          uniform: `[count]` in [0, 1).
          strata: draws are taken in parts of so many, the last one of what is left; a part of k draws takes one from
            each of k equal pieces of the sum (Schaul et al. 2016, B.2.1).

        Returns:
          (slots `[count]`, their numbers `[count]`); never a slot whose number is zero.
        """
        slots, values = np.empty(len(uniform), np.int64), np.empty(len(uniform))
        _find(self._tree, uniform, strata, slots, values)
        return slots, values


@kernel
def _refresh_range(tree, low, high):
    """Recomputes all sums above the leaves `tree[low]` to `tree[high]`."""
    while low > 1:
        low, high = low // 2, high // 2
        for node in range(low, high + 1):
            tree[node] = tree[2 * node] + tree[2 * node + 1]


@kernel
def _put(tree, nodes, values):
    """Sets the leaves `nodes`, which is used up, level by level: neighbours share the sums above them."""
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
def _find(tree, uniform, strata, slots, values):
    """Descends with all draws at once, a level at a time, so that no draw waits for another's memory."""
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
            # what rounding leaves over must not lead to where there is nothing
            goes_right = values[i] >= left and right > 0.0
            values[i] -= left if goes_right else 0.0
            slots[i] = 2 * slots[i] + (1 if goes_right else 0)
        width *= 2
    for i in range(count):
        values[i] = tree[slots[i]]
        slots[i] -= first_leaf
