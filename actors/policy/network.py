"""The Q-network in torch, for learning and export; `actors.policy.policy` acts with its weights."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from actors.policy.policy import WeightsSnapshot


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


class PooledNetwork(nn.Module):
    """A Q-network over rows of groups that does not depend on the order and number of the other groups.

    Two layers, the same for every row but the first, encode a row; the maximum over the rows, beside the first row,
    goes through a multilayer perceptron. M. Zaheer et al., "Deep sets" (NeurIPS 2017), Section 3. A row of zeros is
    absent.

    Args:
      observation_size: number of elements of one observation, a multiple of `row_size`.
      hidden_sizes: width of both shared layers, then of the perceptron's hidden layers.
      num_actions: number of actions.
      row_size: elements of a row.
    """

    def __init__(self, observation_size: int, hidden_sizes: tuple[int, ...], num_actions: int, row_size: int) -> None:
        super().__init__()
        self.shape = (observation_size // row_size, row_size)
        width, *hidden = hidden_sizes
        self.rows = nn.Sequential(nn.Linear(row_size, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.values = QNetwork(row_size + width, tuple(hidden), num_actions)

    def forward(self, observation: Tensor) -> Tensor:
        """Action values `[batch, actions]` float32."""
        rows = observation.float().reshape(-1, *self.shape)
        own, others = rows[:, 0], rows[:, 1:]
        here = (others[..., :1] != 0.0).float()
        pooled = (self.rows(others) * here).amax(dim=1) if self.shape[0] > 1 else self.rows(own) * 0.0
        values: Tensor = self.values(torch.cat([own, pooled], dim=1))
        return values


Network = QNetwork | DuelingNetwork | PooledNetwork


def make_network(
    kind: str, observation_size: int, hidden_sizes: tuple[int, ...], num_actions: int, row_size: int = 0
) -> Network:
    """A network of the kind `plain`, `dueling` or `pooled`; `row_size` is that of pooled ones."""
    if kind == "pooled":
        return PooledNetwork(observation_size, hidden_sizes, num_actions, row_size)
    made = DuelingNetwork if kind == "dueling" else QNetwork
    return made(observation_size, hidden_sizes, num_actions)


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


def snapshot(network: Network, version: int, time_s: float) -> WeightsSnapshot:
    """Copies the parameters of a network; those of a dueling network as the plain network that it is equal to."""
    parameters = [parameter.detach() for parameter in network.parameters()]
    if isinstance(network, DuelingNetwork):
        *parameters, value_weight, value_bias, weight, bias = parameters
        parameters += fold_dueling_head((value_weight, value_bias), (weight, bias))
    arrays = tuple(parameter.cpu().numpy().copy() for parameter in parameters)
    return WeightsSnapshot(version, time_s, arrays, network.shape[1] if isinstance(network, PooledNetwork) else 0)


def load_snapshot(network: Network, weights: WeightsSnapshot) -> None:
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
