"""The policy that acts: a weights snapshot, run by compiled kernels.

For the small batches of a rollout worker, a compiled kernel is several times faster than torch, which no process that
only acts has to import. A test checks that both compute the same function.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.policy.acting_kernels import acting_layer, acting_tile, action_values, best_actions
from actors.policy.mlp_kernels import (
    Floats,
    Layers,
    RowEncoder,
    encode_rows,
    make_row_encoder,
    use_one_blas_thread,
)
from sim_core.jit import StateKernel, kernel


class WeightsSnapshot(NamedTuple):
    """A published policy.

    `version` is the number of updates applied to the weights, `time_s` the wall time of their publication. `arrays`
    holds the weights `[fan_out, fan_in]` and biases `[fan_out]` layer by layer: of a plain network, or if `row_size` is
    above 0, of a pooled one whose observations are rows of so many elements.
    """

    version: int
    time_s: float
    arrays: tuple[NDArray[np.float32], ...]
    row_size: int = 0


def blank_weights(
    observation_size: int, hidden_sizes: tuple[int, ...], num_actions: int, row_size: int = 0
) -> WeightsSnapshot:
    """Weights of zeros of a plain network, or if `row_size` is above 0, of a pooled one; for rehearsals."""
    shared, sizes = list[tuple[int, int]](), (observation_size, *hidden_sizes, num_actions)
    if row_size:
        width, *hidden = hidden_sizes
        shared, sizes = [(row_size, width), (width, width)], (row_size + width, *hidden, num_actions)
    layers = [*shared, *itertools.pairwise(sizes)]
    arrays = [array for fan_in, fan_out in layers for array in (np.zeros((fan_out, fan_in)), np.zeros(fan_out))]
    return WeightsSnapshot(0, 0.0, tuple(array.astype(np.float32) for array in arrays), row_size)


class Policy:
    """The compiled policy of a weights snapshot.

    A plain network remembers the last observation, action and value of every row of a batch, and computes those rows
    whose observation has changed: M_sensor's counts are often those of the decision before. What it says of an
    observation depends on no other one, so this changes nothing. A pooled network is computed by BLAS, whose sums may
    depend on the batch: it computes all rows that decide.

    Args:
      weights: the snapshot to act with.
    """

    def __init__(self, weights: WeightsSnapshot) -> None:
        self.weights = weights
        shared = 4 if weights.row_size else 0  # arrays of the two layers that all rows share
        arrays = weights.arrays[shared:]
        self._num_actions = len(arrays[-1])
        self._layers = tuple(acting_layer(*pair) for pair in zip(arrays[::2], arrays[1::2], strict=True))
        self._tile = acting_tile(self._layers, self._num_actions)
        self._encoder = _Encoder(weights) if weights.row_size else None
        self._known: NDArray[Any] = np.zeros((0, 0))
        self._all, self._action, self._value = np.ones(0, np.bool_), np.zeros(0, np.int64), np.zeros(0, np.float32)

    def values(self, observation: NDArray[np.generic]) -> NDArray[np.float32]:
        """Action values `[batch, actions]` float32 of observations `[batch, *shape]`."""
        inputs = np.ascontiguousarray(observation.reshape(len(observation), -1), np.float32)
        if self._encoder is not None:
            inputs = self._encoder(inputs)
        out = np.empty((len(inputs), self._num_actions), np.float32)
        action_values(self._layers, self._tile, inputs, out)
        return out

    def greedy(self, observation: NDArray[np.generic], decides: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
        """Greedy actions `[batch]` for observations `[batch, *shape]`; the lowest index among equals.

        Where `decides` `[batch]` is not set there is no decision: action 0.
        """
        batch = len(observation)
        flat = np.ascontiguousarray(observation.reshape(batch, -1))
        if flat.shape != self._known.shape or flat.dtype != self._known.dtype:
            self._forget(flat)
        if self._encoder is None:
            mask = self._all if decides is None else decides
            self._best_actions(self._layers, self._tile, flat, self._known, mask, self._action, self._value)
        else:
            rows = slice(None) if decides is None else np.flatnonzero(decides)
            values = self.values(flat[rows])
            self._action[rows], self._value[rows] = values.argmax(axis=1), values.max(axis=1)
        return self._action.copy() if decides is None else np.where(decides, self._action, 0)

    def highest_values(self) -> NDArray[np.float32]:
        """The highest action value `[batch]` of each observation of the last call of `greedy`."""
        return self._value.copy()

    def _forget(self, flat: NDArray[Any]) -> None:
        """Begins with batches `[batch, size]` of another size or dtype: all that is known is what zeros lead to."""
        batch = len(flat)
        self._all, self._best_actions = np.ones(batch, np.bool_), StateKernel(best_actions)
        self._action, self._value = np.zeros(batch, np.int64), np.zeros(batch, np.float32)
        self._known = np.ones_like(flat)
        if self._encoder is None and batch:
            first = np.arange(batch) == 0
            zeros = np.zeros_like(flat)
            self._best_actions(self._layers, self._tile, zeros, self._known, first, self._action, self._value)
            self._action[:], self._value[:] = self._action[0], self._value[0]
        self._known[:] = 0


class _Encoder:
    """The shared layers of a pooled network. Their memory is kept, since allocating it takes as long as filling it."""

    def __init__(self, weights: WeightsSnapshot) -> None:
        use_one_blas_thread()
        copies = [array.copy() for array in weights.arrays[:4]]  # arrays from Ray are read-only: another numba type
        self._layers = Layers(tuple(copies[::2]), tuple(copies[1::2]))
        self._row_size, self._room = weights.row_size, 0
        self._memory: RowEncoder | None = None

    def __call__(self, observation: Floats) -> Floats:
        """The own row, then the maximum over the encoded others `[batch, row_size + width]`."""
        count, size = observation.shape
        if self._memory is None or count > self._room:
            self._memory, self._room = make_row_encoder(count, size // self._row_size, self._layers), count
        out = np.empty((count, self._row_size + len(self._layers.biases[1])), np.float32)
        _encode(observation, self._layers, self._memory, out)
        return out


@kernel
def _encode(observations: Floats, shared: Layers, encoder: RowEncoder, out: Floats) -> None:
    encode_rows(observations, 0, shared, encoder, out)
