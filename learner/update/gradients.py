"""The update's gradients, by automatic differentiation or written by hand; both fill the same flat buffer.

Networks of this size are bound by what surrounds their arithmetic: written by hand, the online network sees both states
in one pass, nothing is recorded for a backward pass, and the gradients are written where the optimiser reads them.
"""

from __future__ import annotations

import copy
from typing import NamedTuple

import torch
from torch import Tensor, nn

from actors.policy.network import DuelingNetwork, QNetwork, fold_dueling_head
from learner.update.double_dqn import Batch, LossName, double_q_target, mean_loss, q_target, targets

Layer = tuple[Tensor, Tensor]
"""Weight `[fan_out, fan_in]` and bias `[fan_out]` of a layer, or their gradients."""


class Measured(NamedTuple):
    """Of one minibatch, before the step: loss, mean action value, mean absolute TD error; scalars.

    `td_errors` `[batch]` are the errors themselves.
    """

    loss: Tensor
    q_mean: Tensor
    td_error: Tensor
    td_errors: Tensor


class FlatNetwork:
    """A Q-network whose parameters, and their gradients, are views of one flat tensor each.

    Args:
      network: is changed so that its parameters are views.

    Attributes:
      network: the network.
      values: all parameters, `[count]` float32, one after the other; `values.grad` their gradients.
      layers: weight and bias of each layer, views; a dueling network's last two are its streams' own.
      gradients: the same of the gradients.
    """

    def __init__(self, network: QNetwork | DuelingNetwork) -> None:
        parameters = list(network.parameters())
        flat = torch.cat([parameter.detach().reshape(-1) for parameter in parameters])
        self.network = network
        self.values = nn.Parameter(flat)
        self.values.grad = torch.zeros_like(flat)
        sizes = [parameter.numel() for parameter in parameters]
        pieces = zip(parameters, torch.split(flat, sizes), torch.split(self.values.grad, sizes), strict=True)
        views, slopes = [], []
        for parameter, value, slope in pieces:
            parameter.data = value.view_as(parameter)
            parameter.grad = slope.view_as(parameter)
            views.append(parameter.data)
            slopes.append(parameter.grad)
        self.layers: list[Layer] = list(zip(views[::2], views[1::2], strict=True))
        self.gradients: list[Layer] = list(zip(slopes[::2], slopes[1::2], strict=True))

    def clip_gradients(self, max_norm: float) -> None:
        """Scales the gradients down to the norm `max_norm`, as `torch.nn.utils.clip_grad_norm_` does."""
        assert self.values.grad is not None
        norm = torch.linalg.vector_norm(self.values.grad)
        self.values.grad.mul_((max_norm / (norm + 1e-6)).clamp_(max=1.0))

    def copy(self) -> FlatNetwork:
        """Another network with the same parameters."""
        return FlatNetwork(copy.deepcopy(self.network))


class AutogradGradients:
    """Gradients by PyTorch, for any network and to check others against.

    Args:
      online, target: the networks.
      double: Double DQN or DQN.
      loss: of the TD errors (see `mean_loss`).
    """

    def __init__(self, online: FlatNetwork, target: FlatNetwork, double: bool, loss: LossName) -> None:
        self._online = online
        self._target = target
        self._double = double
        self._loss = loss

    def __call__(self, batch: Batch) -> Measured:
        """Writes the loss's gradient to the online network's `values.grad`."""
        fixed = targets(batch, self._online.network, self._target.network, self._double)
        q_tm1 = self._online.network(batch.s_tm1)
        loss, td_errors = mean_loss(q_tm1, batch.a_tm1, fixed, self._loss, batch.weight)
        assert self._online.values.grad is not None
        self._online.values.grad.zero_()
        loss.backward()  # type: ignore[no-untyped-call]
        return Measured(loss.detach(), q_tm1.detach().mean(), td_errors.abs().mean(), td_errors)


class HandWrittenGradients:
    """Gradients of a multilayer perceptron with ReLU, written out (see AutogradGradients for the arguments).

    A dueling network's head is a linear map of its streams, so that the network is such a perceptron, too: its head
    is folded into one layer on the way forward, and that layer's gradients are unfolded on the way back.
    """

    def __init__(self, online: FlatNetwork, target: FlatNetwork, double: bool, loss: LossName) -> None:
        self._online = online
        self._target = target
        self._double = double
        self._loss = loss

    @torch.no_grad()
    def __call__(self, batch: Batch) -> Measured:
        """Writes the loss's gradient to the online network's `values.grad`."""
        size = len(batch.a_tm1)
        s_tm1, s_t = batch.s_tm1.flatten(1), batch.s_t.flatten(1)
        seen = torch.cat([s_tm1, s_t]) if self._double else s_tm1
        layers = _plain_layers(self._online)
        activations = _forward(layers, seen)
        q_tm1, q_t_target = activations[-1][:size], _forward(_plain_layers(self._target), s_t)[-1]
        if self._double:
            fixed = double_q_target(activations[-1][size:], q_t_target, batch.r_t, batch.discount_t)
        else:
            fixed = q_target(q_t_target, batch.r_t, batch.discount_t)
        action = batch.a_tm1.unsqueeze(1)
        td_errors = fixed - q_tm1.gather(1, action).squeeze(1)
        losses, slope = _losses(self._loss, td_errors)
        if batch.weight is not None:
            losses, slope = batch.weight * losses, batch.weight * slope
        delta = torch.zeros_like(q_tm1).scatter_(1, action, slope.div(-size).unsqueeze(1))
        self._backward(layers, [layer[:size] for layer in activations[:-1]], delta)
        return Measured(losses.mean(), q_tm1.mean(), td_errors.abs().mean(), td_errors)

    def _backward(self, layers: list[Layer], inputs: list[Tensor], delta: Tensor) -> None:
        """Back-propagates `delta` `[batch, actions]`, the loss's derivative by the action values."""
        last = len(layers) - 1
        for i in reversed(range(len(layers))):
            if i == last and isinstance(self._online.network, DuelingNetwork):
                _unfold_slopes(delta.t() @ inputs[i], delta.sum(dim=0), *self._online.gradients[-2:])
            else:
                weight_slope, bias_slope = self._online.gradients[i]
                torch.mm(delta.t(), inputs[i], out=weight_slope)
                torch.sum(delta, dim=0, out=bias_slope)
            if i:
                delta = torch.mm(delta, layers[i][0])
                delta = torch.ops.aten.threshold_backward(delta, inputs[i], 0)  # ReLU's slope, 1 above 0


def _losses(loss: LossName, td_errors: Tensor) -> tuple[Tensor, Tensor]:
    """Every TD error's loss (see `mean_loss`) and its derivative, `[batch]` each."""
    if loss == "mse":
        return td_errors.square(), 2.0 * td_errors
    slope = td_errors.clamp(-1.0, 1.0)
    return slope * (td_errors - 0.5 * slope), slope


def _plain_layers(network: FlatNetwork) -> list[Layer]:
    """The layers of the perceptron that the network is."""
    if not isinstance(network.network, DuelingNetwork):
        return network.layers
    *layers, value, advantage = network.layers
    return [*layers, fold_dueling_head(value, advantage)]


def _unfold_slopes(weight_slope: Tensor, bias_slope: Tensor, value: Layer, advantage: Layer) -> None:
    """Writes what a folded head's gradients mean for the streams' own layers to `value` and `advantage`."""
    width = value[0].shape[1]
    torch.sum(weight_slope[:, :width], dim=0, keepdim=True, out=value[0])
    torch.sum(bias_slope, dim=0, keepdim=True, out=value[1])
    by_advantage = weight_slope[:, width:]
    torch.sub(by_advantage, by_advantage.mean(dim=0), out=advantage[0])
    torch.sub(bias_slope, bias_slope.mean(), out=advantage[1])


def _forward(layers: list[Layer], observation: Tensor) -> list[Tensor]:
    """The observation, every hidden layer after its ReLU, and the action values; `[batch, width]` each."""
    activations = [observation]
    for i, (weight, bias) in enumerate(layers):
        out = torch.addmm(bias, activations[-1], weight.t())
        activations.append(out.relu_() if i + 1 < len(layers) else out)
    return activations


GRADIENTS: dict[str, type[HandWrittenGradients] | type[AutogradGradients]] = {
    "by_hand": HandWrittenGradients,
    "autograd": AutogradGradients,
}
