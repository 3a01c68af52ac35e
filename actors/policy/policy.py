"""The policy that acts: a weights snapshot, run by compiled kernels.

For the small batches of a rollout worker, a compiled kernel is several times faster than torch, which no process that
only acts has to import. A test checks that both compute the same function.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.policy.mlp_kernels import (
    Floats,
    Layers,
    RowEncoder,
    best_action,
    encode_rows,
    forward,
    make_row_encoder,
    make_workspace,
    use_one_blas_thread,
)
from sim_core.jit import kernel


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

    The workspace is kept between calls, since allocating it takes as long as filling it; smaller batches take a part.

    Args:
      weights: the snapshot to act with.
    """

    def __init__(self, weights: WeightsSnapshot) -> None:
        use_one_blas_thread()
        self.weights = weights
        copies = [array.copy() for array in weights.arrays]  # arrays from Ray are read-only: another numba type
        shared = 4 if weights.row_size else 0  # arrays of the two layers that all rows share
        self._shared = Layers(tuple(copies[:shared:2]), tuple(copies[1:shared:2]))
        self._layers = Layers(tuple(copies[shared::2]), tuple(copies[shared + 1 :: 2]))
        self._room = self._workspace = make_workspace(0, self._layers)
        self._encoder: RowEncoder | None = None

    def values(self, observation: NDArray[np.generic]) -> NDArray[np.float32]:
        """Action values `[batch, actions]` float32 of observations `[batch, *shape]`."""
        self._load(observation)
        _values(self._layers, self._workspace)
        return self._workspace[-1].copy()

    def greedy(self, observation: NDArray[np.generic]) -> NDArray[np.int64]:
        """Greedy actions `[batch]` for observations `[batch, *shape]`; the lowest index among equals."""
        self._load(observation)
        actions = np.empty(len(observation), np.int64)
        _greedy(self._layers, self._workspace, actions)
        return actions

    def highest_values(self) -> NDArray[np.float32]:
        """The highest action value `[batch]` of each observation of the last call."""
        highest: NDArray[np.float32] = self._workspace[-1].max(axis=1)
        return highest

    def _load(self, observation: NDArray[np.generic]) -> None:
        count = len(observation)
        if len(self._room[0]) < count:
            self._room, self._encoder = make_workspace(count, self._layers), None
        self._workspace = tuple(array[:count] for array in self._room)
        if not self.weights.row_size:
            self._workspace[0][...] = observation.reshape(count, -1)
            return
        rows = np.ascontiguousarray(observation.reshape(count, -1), np.float32)
        if self._encoder is None:
            most = len(self._room[0])
            self._encoder = make_row_encoder(most, rows.shape[1] // self.weights.row_size, self._shared)
        _encode(rows, self._shared, self._encoder, self._workspace[0])


@kernel
def _encode(observations: Floats, shared: Layers, encoder: RowEncoder, out: Floats) -> None:
    encode_rows(observations, 0, shared, encoder, out)


@kernel
def _values(layers: Layers, workspace: tuple[Floats, ...]) -> None:
    forward(layers, workspace)


@kernel
def _greedy(layers: Layers, workspace: tuple[Floats, ...], actions: NDArray[np.int64]) -> None:
    forward(layers, workspace)
    for row in range(len(actions)):
        actions[row] = best_action(workspace[-1], row)
