"""The Q-network: in torch where it learns, in numpy where it acts.

A rollout worker's batches are small, where numpy is several times faster than torch and needs no torch
in the worker's process; both compute the same function (tested).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn


class WeightsSnapshot(NamedTuple):
    """A published policy: weights and biases of each layer in turn, float32.

    `version` is the number of updates behind it, `time_s` the wall time of its publication.
    """

    version: int
    time_s: float
    arrays: tuple[NDArray[np.float32], ...]


class QNetwork(nn.Module):
    """A multilayer perceptron with ReLU, observations `[batch, *shape]` to action values `[batch, actions]`.

    Args:
      observation_size: number of elements of one observation.
      hidden_sizes: width of every hidden layer.
      num_actions: number of actions.
    """

    def __init__(self, observation_size: int, hidden_sizes: tuple[int, ...], num_actions: int) -> None:
        super().__init__()
        sizes = (observation_size, *hidden_sizes, num_actions)
        layers: list[nn.Module] = []
        for fan_in, fan_out in zip(sizes[:-1], sizes[1:], strict=True):
            layers += [nn.Linear(fan_in, fan_out), nn.ReLU()]
        self.layers = nn.Sequential(*layers[:-1])

    def forward(self, observation: Tensor) -> Tensor:
        """Action values `[batch, actions]` float32."""
        values: Tensor = self.layers(observation.flatten(1).float())
        return values


def snapshot(network: QNetwork, version: int, time_s: float) -> WeightsSnapshot:
    """Copies the network's parameters out."""
    arrays = tuple(parameter.detach().cpu().numpy().copy() for parameter in network.parameters())
    return WeightsSnapshot(version, time_s, arrays)


def load_snapshot(network: QNetwork, weights: WeightsSnapshot) -> None:
    """Copies a snapshot's parameters into the network.

    Raises:
      ValueError: the snapshot is of a network of another shape.
    """
    parameters = list(network.parameters())
    if [tuple(parameter.shape) for parameter in parameters] != [array.shape for array in weights.arrays]:
        raise ValueError("the saved weights are of a network of another shape")
    with torch.no_grad():
        for parameter, array in zip(parameters, weights.arrays, strict=True):
            parameter.copy_(torch.from_numpy(array))


class Policy:
    """Action values in numpy from published weights.

    Args:
      weights: the snapshot to act with.
    """

    def __init__(self, weights: WeightsSnapshot) -> None:
        self.weights = weights
        arrays = weights.arrays
        self._layers = [(matrix.T, bias) for matrix, bias in zip(arrays[::2], arrays[1::2], strict=True)]

    def values(self, observation: NDArray[np.generic]) -> NDArray[np.float32]:
        """Action values `[batch, actions]` of observations `[batch, *shape]`."""
        x = observation.reshape(len(observation), -1).astype(np.float32)
        for matrix, bias in self._layers[:-1]:
            x = x @ matrix
            x += bias
            np.maximum(x, 0, out=x)
        matrix, bias = self._layers[-1]
        return np.asarray(x @ matrix + bias, np.float32)

    def greedy(self, observation: NDArray[np.generic]) -> NDArray[np.int64]:
        """Best actions `[batch]`; the lowest index among equals."""
        best: NDArray[np.int64] = np.argmax(self.values(observation), axis=1)
        return best
