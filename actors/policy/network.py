"""The Q-network: in torch for learning, as a compiled kernel for acting.

For the small batches of a rollout worker, a compiled kernel is several times faster than torch. A test checks that both
compute the same function.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

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


class QNetwork(nn.Module):
    """A multilayer perceptron with ReLU: observations `[batch, *shape]` to action values `[batch, actions]`.

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
    """A dueling Q-network: Q(s, a) = V(s) + A(s, a) - mean over a' of A(s, a').

    Z. Wang et al., "Dueling network architectures for deep reinforcement learning" (ICML 2016), Equation 9. The two
    streams share all hidden layers but the last. Their last hidden layers are stored as one, V's half first.

    Args:
      observation_size: number of elements of one observation.
      hidden_sizes: width of every hidden layer; the last one is the width per stream.
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


def fold_dueling_head(value: tuple[Tensor, Tensor], advantage: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Folds the output layers of a dueling network into one linear layer that computes the same action values.

    Args:
      value, advantage: (weight, bias) of the output layer of each stream.

    Returns:
      (weight `[actions, 2 * width]`, bias `[actions]`).
    """
    (value_weight, value_bias), (weight, bias) = value, advantage
    centred = weight - weight.mean(dim=0)
    return torch.cat([value_weight.expand_as(centred), centred], dim=1), value_bias + bias - bias.mean()


def snapshot(network: QNetwork | DuelingNetwork, version: int, time_s: float) -> WeightsSnapshot:
    """Copies the parameters of a network; those of a dueling network as the plain network that it is equal to."""
    parameters = [parameter.detach() for parameter in network.parameters()]
    if isinstance(network, DuelingNetwork):
        *parameters, value_weight, value_bias, weight, bias = parameters
        parameters += fold_dueling_head((value_weight, value_bias), (weight, bias))
    arrays = tuple(parameter.cpu().numpy().copy() for parameter in parameters)
    return WeightsSnapshot(version, time_s, arrays)


def load_snapshot(network: QNetwork, weights: WeightsSnapshot) -> None:
    """Copies the parameters of a snapshot into a network.

    Raises:
      ValueError: the snapshot's network has another shape.
    """
    parameters = list(network.parameters())
    if [tuple(parameter.shape) for parameter in parameters] != [array.shape for array in weights.arrays]:
        raise ValueError("the saved weights are of a network of another shape")
    with torch.no_grad():
        for parameter, array in zip(parameters, weights.arrays, strict=True):
            parameter.copy_(torch.tensor(array))  # a copy, since arrays from Ray are read-only


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
