"""The Q-network: in torch, and compiled where it acts.

A rollout worker's batches are small, where a compiled kernel is several times faster than torch; both compute the same
function (tested).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from actors.policy.mlp_kernels import Floats, Layers, best_of, forward, make_room
from sim_core.jit import kernel


class WeightsSnapshot(NamedTuple):
    """A published policy: weights and biases of each layer of a plain network in turn, float32.

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


class DuelingNetwork(nn.Module):
    """A Q-network of two streams, Q(s, a) = V(s) + A(s, a) - mean over a' of A(s, a').

    Z. Wang et al., "Dueling network architectures for deep reinforcement learning" (ICML 2016), Equation 9. All hidden
    layers but the last are shared; the last one is two, a stream's each. They lie in one matrix, V's half first.

    Args:
      observation_size: number of elements of one observation.
      hidden_sizes: width of every hidden layer; the last is that of each stream.
      num_actions: number of actions.
    """

    def __init__(self, observation_size: int, hidden_sizes: tuple[int, ...], num_actions: int) -> None:
        super().__init__()
        *shared, self.width = hidden_sizes
        sizes = (observation_size, *shared, 2 * self.width)
        layers: list[nn.Module] = []
        for fan_in, fan_out in zip(sizes[:-1], sizes[1:], strict=True):
            layers += [nn.Linear(fan_in, fan_out), nn.ReLU()]
        self.layers = nn.Sequential(*layers)
        self.value = nn.Linear(self.width, 1)
        self.advantage = nn.Linear(self.width, num_actions)

    def forward(self, observation: Tensor) -> Tensor:
        """Action values `[batch, actions]` float32."""
        streams = self.layers(observation.flatten(1).float())
        advantage = self.advantage(streams[:, self.width :])
        values: Tensor = self.value(streams[:, : self.width]) + advantage - advantage.mean(dim=1, keepdim=True)
        return values


NETWORKS: dict[str, type[QNetwork] | type[DuelingNetwork]] = {"plain": QNetwork, "dueling": DuelingNetwork}


def folded_head(value: tuple[Tensor, Tensor], advantage: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """The one linear layer that a dueling network's head is: weight `[actions, 2 width]`, bias `[actions]`.

    Args:
      value, advantage: (weight, bias) of either stream's last layer.
    """
    (value_weight, value_bias), (weight, bias) = value, advantage
    centred = weight - weight.mean(dim=0)
    return torch.cat([value_weight.expand_as(centred), centred], dim=1), value_bias + bias - bias.mean()


def snapshot(network: QNetwork | DuelingNetwork, version: int, time_s: float) -> WeightsSnapshot:
    """Copies the network's parameters out; a dueling network's as those of the plain network that it equals."""
    parameters = [parameter.detach() for parameter in network.parameters()]
    if isinstance(network, DuelingNetwork):
        *parameters, value_weight, value_bias, weight, bias = parameters
        parameters += folded_head((value_weight, value_bias), (weight, bias))
    arrays = tuple(parameter.cpu().numpy().copy() for parameter in parameters)
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
            parameter.copy_(torch.tensor(array))  # a copy: what Ray gives cannot be written to


class Policy:
    """Action values from published weights, compiled.

    Layers lie in memory that is kept between calls: to ask for it anew costs as much as what is written to it.

    Args:
      weights: the snapshot to act with.
    """

    def __init__(self, weights: WeightsSnapshot) -> None:
        self.weights = weights
        copies = [array.copy() for array in weights.arrays]  # what Ray gives is read-only, another type to numba
        self._layers = Layers(tuple(copies[::2]), tuple(copies[1::2]))
        self._room = make_room(0, self._layers)

    def values(self, observation: NDArray[np.generic]) -> NDArray[np.float32]:
        """Action values `[batch, actions]` of observations `[batch, *shape]`."""
        self._see(observation)
        _values(self._layers, self._room)
        return self._room[-1].copy()

    def greedy(self, observation: NDArray[np.generic]) -> NDArray[np.int64]:
        """Best actions `[batch]`; the lowest index among equals."""
        self._see(observation)
        actions = np.empty(len(observation), np.int64)
        _greedy(self._layers, self._room, actions)
        return actions

    def _see(self, observation: NDArray[np.generic]) -> None:
        count = len(observation)
        if len(self._room[0]) != count:
            self._room = make_room(count, self._layers)
        self._room[0][...] = observation.reshape(count, -1)


@kernel
def _values(layers: Layers, room: tuple[Floats, ...]) -> None:
    forward(layers, room)


@kernel
def _greedy(layers: Layers, room: tuple[Floats, ...], actions: NDArray[np.int64]) -> None:
    forward(layers, room)
    for row in range(len(actions)):
        actions[row] = best_of(room[-1], row)
