"""The update's gradients, by automatic differentiation or written by hand; both fill the same flat buffer.

Networks of this size are bound by what surrounds their arithmetic: written by hand, the online network sees both states
in one pass, nothing is recorded for a backward pass, and the gradients are written where the optimiser reads them.
"""

from __future__ import annotations

import copy
from typing import NamedTuple

import torch
from torch import Tensor, nn

from actors.network import QNetwork
from learner.double_dqn import Batch, double_q_target, huber_loss, q_target, targets


class Measured(NamedTuple):
    """Of one minibatch, before the step: loss, mean action value, mean absolute TD error; scalars."""

    loss: Tensor
    q_mean: Tensor
    td_error: Tensor


class FlatNetwork:
    """A Q-network whose parameters, and their gradients, are views of one flat tensor each.

    Args:
      network: is changed so that its parameters are views.

    Attributes:
      network: the network.
      values: all parameters, `[count]` float32, one after the other; `values.grad` their gradients.
      layers: (weight `[fan_out, fan_in]`, bias `[fan_out]`) of each layer, views.
      gradients: the same of the gradients.
    """

    def __init__(self, network: QNetwork) -> None:
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
        self.layers = list(zip(views[::2], views[1::2], strict=True))
        self.gradients = list(zip(slopes[::2], slopes[1::2], strict=True))

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
    """

    def __init__(self, online: FlatNetwork, target: FlatNetwork, double: bool) -> None:
        self._online = online
        self._target = target
        self._double = double

    def __call__(self, batch: Batch) -> Measured:
        """Writes the loss's gradient to the online network's `values.grad`."""
        fixed = targets(batch, self._online.network, self._target.network, self._double)
        q_tm1 = self._online.network(batch.s_tm1)
        loss, td_error = huber_loss(q_tm1, batch.a_tm1, fixed)
        assert self._online.values.grad is not None
        self._online.values.grad.zero_()
        loss.backward()  # type: ignore[no-untyped-call]
        return Measured(loss.detach(), q_tm1.detach().mean(), td_error.abs().mean())


class HandWrittenGradients:
    """Gradients of a multilayer perceptron with ReLU, written out (see AutogradGradients for the arguments)."""

    def __init__(self, online: FlatNetwork, target: FlatNetwork, double: bool) -> None:
        self._online = online
        self._target = target
        self._double = double

    @torch.no_grad()
    def __call__(self, batch: Batch) -> Measured:
        """Writes the loss's gradient to the online network's `values.grad`."""
        size = len(batch.a_tm1)
        s_tm1, s_t = batch.s_tm1.flatten(1), batch.s_t.flatten(1)
        seen = torch.cat([s_tm1, s_t]) if self._double else s_tm1
        activations = _forward(self._online, seen)
        q_tm1, q_t_target = activations[-1][:size], _forward(self._target, s_t)[-1]
        if self._double:
            fixed = double_q_target(activations[-1][size:], q_t_target, batch.r_t, batch.discount_t)
        else:
            fixed = q_target(q_t_target, batch.r_t, batch.discount_t)
        action = batch.a_tm1.unsqueeze(1)
        td_error = fixed - q_tm1.gather(1, action).squeeze(1)
        slope = td_error.clamp(-1.0, 1.0)  # of Huber's loss, delta = 1
        loss = (slope * (td_error - 0.5 * slope)).mean()
        self._backward([layer[:size] for layer in activations], action, slope.div(-size).unsqueeze(1))
        return Measured(loss, q_tm1.mean(), td_error.abs().mean())

    def _backward(self, activations: list[Tensor], action: Tensor, slope: Tensor) -> None:
        """Back-propagates `slope` `[batch, 1]`, the loss's derivative by the taken actions' values."""
        delta = torch.zeros_like(activations[-1]).scatter_(1, action, slope)
        for i in reversed(range(len(self._online.layers))):
            weight_slope, bias_slope = self._online.gradients[i]
            torch.mm(delta.t(), activations[i], out=weight_slope)
            torch.sum(delta, dim=0, out=bias_slope)
            if i:
                delta = torch.mm(delta, self._online.layers[i][0])
                delta = torch.ops.aten.threshold_backward(delta, activations[i], 0)  # ReLU's slope, 1 above 0


def _forward(network: FlatNetwork, observation: Tensor) -> list[Tensor]:
    """The observation, every hidden layer after its ReLU, and the action values; `[batch, width]` each."""
    activations = [observation]
    for i, (weight, bias) in enumerate(network.layers):
        out = torch.addmm(bias, activations[-1], weight.t())
        activations.append(out.relu_() if i + 1 < len(network.layers) else out)
    return activations


GRADIENTS: dict[str, type[HandWrittenGradients] | type[AutogradGradients]] = {
    "by_hand": HandWrittenGradients,
    "autograd": AutogradGradients,
}
