"""The policy that acts: a weights snapshot, run by compiled kernels.

For the small batches of a rollout worker, a compiled kernel is several times faster than torch, which no process that
only acts has to import. A test checks that both compute the same function.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.policy.mlp_kernels import Floats, Layers, best_action, forward, make_workspace
from sim_core.jit import kernel


class WeightsSnapshot(NamedTuple):
    """A published policy.

    `version` is the number of updates applied to the weights, `time_s` the wall time of their publication. `arrays`
    holds the weights `[fan_out, fan_in]` and biases `[fan_out]` of a plain network, layer by layer.
    """

    version: int
    time_s: float
    arrays: tuple[NDArray[np.float32], ...]


class Policy:
    """The compiled policy of a weights snapshot.

    The workspace is kept between calls, since allocating it takes as long as filling it.

    Args:
      weights: the snapshot to act with.
    """

    def __init__(self, weights: WeightsSnapshot) -> None:
        self.weights = weights
        copies = [array.copy() for array in weights.arrays]  # arrays from Ray are read-only: another numba type
        self._layers = Layers(tuple(copies[::2]), tuple(copies[1::2]))
        self._workspace = make_workspace(0, self._layers)

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

    def _load(self, observation: NDArray[np.generic]) -> None:
        count = len(observation)
        if len(self._workspace[0]) != count:
            self._workspace = make_workspace(count, self._layers)
        self._workspace[0][...] = observation.reshape(count, -1)


@kernel
def _values(layers: Layers, workspace: tuple[Floats, ...]) -> None:
    forward(layers, workspace)


@kernel
def _greedy(layers: Layers, workspace: tuple[Floats, ...], actions: NDArray[np.int64]) -> None:
    forward(layers, workspace)
    for row in range(len(actions)):
        actions[row] = best_action(workspace[-1], row)
