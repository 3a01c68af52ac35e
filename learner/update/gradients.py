"""The update's gradients in PyTorch, by autograd or written by hand; both fill the same flat buffer.

Networks of this size are bound by overhead, not by arithmetic. Written by hand, the online network sees both states in
one pass, nothing is recorded for a backward pass, and the gradients are written where the optimiser reads them.

The same update is implemented three times, each for a use of its own. Autograd is the reference that tests hold the
other two against, and the option `gradients = "autograd"`. The one by hand runs on CUDA, and dueling networks on the
CPU. `compiled_updates` runs plain networks on the CPU.
"""

from __future__ import annotations

import copy
from typing import NamedTuple

import torch
from torch import Tensor, nn

from actors.policy.network import DuelingNetwork, Network, fold_dueling_head
from learner.update.double_dqn import Batch, LossName, margin_losses, mean_loss, td_targets

Layer = tuple[Tensor, Tensor]
"""Weight `[fan_out, fan_in]` and bias `[fan_out]` of a layer, or their gradients."""


class MinibatchStats(NamedTuple):
    """Statistics of one minibatch before its step: loss, mean action value and mean absolute TD error are scalars.

    `td_errors` are the TD errors `[batch]`.
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
      values: all parameters, `[count]` float32; `values.grad` are their gradients.
      layers: weight and bias of each layer, as views; the last two of a dueling network are those of its streams.
      grads: the gradients of each layer, as views.
    """

    def __init__(self, network: Network) -> None:
        parameters = list(network.parameters())
        flat = torch.cat([parameter.detach().reshape(-1) for parameter in parameters])
        self.network = network
        self.values = nn.Parameter(flat)
        self.values.grad = torch.zeros_like(flat)
        sizes = [parameter.numel() for parameter in parameters]
        pieces = zip(parameters, torch.split(flat, sizes), torch.split(self.values.grad, sizes), strict=True)
        views, grads = [], []
        for parameter, value, grad in pieces:
            parameter.data = value.view_as(parameter)
            parameter.grad = grad.view_as(parameter)
            views.append(parameter.data)
            grads.append(parameter.grad)
        self.layers: list[Layer] = list(zip(views[::2], views[1::2], strict=True))
        self.grads: list[Layer] = list(zip(grads[::2], grads[1::2], strict=True))

    def clip_gradients(self, max_norm: float) -> None:
        """Scales the gradients down to the norm `max_norm`, as `torch.nn.utils.clip_grad_norm_` does."""
        assert self.values.grad is not None
        norm = torch.linalg.vector_norm(self.values.grad)
        self.values.grad.mul_((max_norm / (norm + 1e-6)).clamp_(max=1.0))

    def copy(self) -> FlatNetwork:
        """Another network with the same parameters."""
        return FlatNetwork(copy.deepcopy(self.network))


class _Gradients:
    """What both kinds of gradients work on.

    Args:
      online, target: the networks.
      double: Double DQN or DQN.
      loss: of the TD errors (see `mean_loss`).
      margin: of a teacher's actions (see `margin_losses`).
    """

    def __init__(
        self, online: FlatNetwork, target: FlatNetwork, double: bool, loss: LossName, margin: float = 0.0
    ) -> None:
        self._online = online
        self._target = target
        self._double = double
        self._loss = loss
        self._margin = margin


class AutogradGradients(_Gradients):
    """Gradients by autograd, for any network."""

    def __call__(self, batch: Batch) -> MinibatchStats:
        """Writes the loss's gradient to the online network's `values.grad`."""
        with torch.no_grad():
            q_t = self._target.network(batch.s_t)
            selector = self._online.network(batch.s_t) if self._double else q_t
        target = td_targets(q_t, selector, batch.r_t, batch.discount_t)
        q_tm1 = self._online.network(batch.s_tm1)
        loss, td_errors = mean_loss(q_tm1, batch.a_tm1, target, self._loss, batch.weight)
        if batch.teacher is not None and batch.teacher_weight is not None:
            taught, _ = margin_losses(q_tm1, batch.teacher, self._margin)
            loss = loss + (batch.teacher_weight * taught).mean()
        assert self._online.values.grad is not None
        self._online.values.grad.zero_()
        loss.backward()  # type: ignore[no-untyped-call]
        return MinibatchStats(loss.detach(), q_tm1.detach().mean(), td_errors.abs().mean(), td_errors)


class HandWrittenGradients(_Gradients):
    """Backpropagation through a multilayer perceptron with ReLU, written out.

    The head of a dueling network is a linear map of its streams, so such a network is a perceptron, too: the head is
    folded into one layer for the forward pass, and that layer's gradients are unfolded in the backward pass.
    """

    @torch.no_grad()
    def __call__(self, batch: Batch) -> MinibatchStats:
        """Writes the loss's gradient to the online network's `values.grad`."""
        size = len(batch.a_tm1)
        s_tm1, s_t = batch.s_tm1.flatten(1), batch.s_t.flatten(1)
        layers = _plain_layers(self._online)
        activations = _forward(layers, torch.cat([s_tm1, s_t]) if self._double else s_tm1)
        q_tm1, q_t = activations[-1][:size], _forward(_plain_layers(self._target), s_t)[-1]
        selector = activations[-1][size:] if self._double else q_t
        target = td_targets(q_t, selector, batch.r_t, batch.discount_t)
        action = batch.a_tm1.unsqueeze(1)
        td_errors = target - q_tm1.gather(1, action).squeeze(1)
        losses, grad = _losses(self._loss, td_errors)
        if batch.weight is not None:
            losses, grad = batch.weight * losses, batch.weight * grad
        delta = torch.zeros_like(q_tm1).scatter_(1, action, grad.div(-size).unsqueeze(1))
        if batch.teacher is not None and batch.teacher_weight is not None:
            taught, rival = margin_losses(q_tm1, batch.teacher, self._margin)
            losses = losses + batch.teacher_weight * taught
            share = batch.teacher_weight.div(size).unsqueeze(1)
            delta.scatter_add_(1, rival.unsqueeze(1), share)
            delta.scatter_add_(1, batch.teacher.unsqueeze(1), -share)
        self._backward(layers, [layer[:size] for layer in activations[:-1]], delta)
        return MinibatchStats(losses.mean(), q_tm1.mean(), td_errors.abs().mean(), td_errors)

    def _backward(self, layers: list[Layer], inputs: list[Tensor], delta: Tensor) -> None:
        """Backpropagates `delta`, the gradient of the loss with respect to the action values, `[batch, actions]`."""
        last = len(layers) - 1
        for i in reversed(range(len(layers))):
            if i == last and isinstance(self._online.network, DuelingNetwork):
                _unfold_head(delta.t() @ inputs[i], delta.sum(dim=0), *self._online.grads[-2:])
            else:
                weight_grad, bias_grad = self._online.grads[i]
                torch.mm(delta.t(), inputs[i], out=weight_grad)
                torch.sum(delta, dim=0, out=bias_grad)
            if i:
                delta = torch.mm(delta, layers[i][0])
                delta = torch.ops.aten.threshold_backward(delta, inputs[i], 0)  # ReLU


def _losses(loss: LossName, td_errors: Tensor) -> tuple[Tensor, Tensor]:
    """Loss of each TD error (see `mean_loss`) and its derivative, `[batch]` each."""
    if loss == "mse":
        return td_errors.square(), 2.0 * td_errors
    grad = td_errors.clamp(-1.0, 1.0)
    return grad * (td_errors - 0.5 * grad), grad


def _plain_layers(network: FlatNetwork) -> list[Layer]:
    """The layers of the perceptron that the network is equal to."""
    if not isinstance(network.network, DuelingNetwork):
        return network.layers
    *layers, value, advantage = network.layers
    return [*layers, fold_dueling_head(value, advantage)]


def _unfold_head(weight_grad: Tensor, bias_grad: Tensor, value: Layer, advantage: Layer) -> None:
    """Writes the gradients of a folded head to those of the two streams' last layers, `value` and `advantage`."""
    width = value[0].shape[1]
    torch.sum(weight_grad[:, :width], dim=0, keepdim=True, out=value[0])
    torch.sum(bias_grad, dim=0, keepdim=True, out=value[1])
    by_advantage = weight_grad[:, width:]
    torch.sub(by_advantage, by_advantage.mean(dim=0), out=advantage[0])
    torch.sub(bias_grad, bias_grad.mean(), out=advantage[1])


def _forward(layers: list[Layer], observation: Tensor) -> list[Tensor]:
    """Activations `[batch, width]`: the observation, each hidden layer after its ReLU, and the action values."""
    activations = [observation]
    for i, (weight, bias) in enumerate(layers):
        out = torch.addmm(bias, activations[-1], weight.t())
        activations.append(out.relu_() if i + 1 < len(layers) else out)
    return activations


GRADIENTS: dict[str, type[HandWrittenGradients] | type[AutogradGradients]] = {
    "by_hand": HandWrittenGradients,
    "autograd": AutogradGradients,
}
