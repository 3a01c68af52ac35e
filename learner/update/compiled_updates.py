"""Compiled updates: a kernel makes all updates of a call, without Python or PyTorch between two minibatches.

For plain and pooled networks on the CPU. Small networks are bound by overhead; here the overhead is a few loops over
contiguous memory, and the matrix products are those of SciPy's BLAS. The arithmetic is that of
`learner.update.gradients` and of PyTorch's Adam on the same memory, with equal results up to rounding.

One shortcut: the gradient is non-zero only for the taken action (and for a teacher's and its rival), so the last
layer's backward pass needs no matrix product.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from actors.policy.mlp_kernels import (
    Floats,
    Layers,
    RowEncoder,
    best_action,
    encode_rows,
    forward,
    make_row_encoder,
    make_workspace,
    multiply,
    squared_norm,
    use_one_blas_thread,
)
from actors.policy.network import PooledNetwork
from learner.config import RunConfig
from learner.update.adam import BETA1, BETA2, EPSILON, Adam
from learner.update.gradients import FlatNetwork
from learner.update.stats import UpdateStats
from sim_core.jit import inlined, kernel


class _SuperBatch(NamedTuple):
    """Columns of a super-batch: states `[rows, size]`, the others `[rows]`."""

    s_tm1: Floats
    a_tm1: NDArray[np.int64]
    r_t: Floats
    discount_t: Floats
    s_t: Floats
    weight: Floats
    teacher: NDArray[np.int64]
    teacher_weight: Floats


class _Flat(NamedTuple):
    """Flat arrays `[parameters]`: the online network, its gradients and Adam's moments, and the target network."""

    values: Floats
    grads: Floats
    exp_avg: Floats
    exp_avg_sq: Floats
    target: Floats


class _Workspace(NamedTuple):
    """Memory of one minibatch.

    `online` and `other` hold states, hidden layers and action values, `[batch, width]` each. `other` holds the
    activations of the target network first, and then the gradients with respect to the online network's activations.
    `td_target` `[batch]` are the TD targets, `grad` `[batch]` the gradient with respect to the taken action's value.
    `rival` `[batch]` are the actions that a teacher's must exceed, `margin_grad` `[batch]` the gradient with respect to
    their values; that of the teacher's action is its negative.
    """

    online: tuple[Floats, ...]
    other: tuple[Floats, ...]
    td_target: Floats
    grad: Floats
    rival: NDArray[np.int64]
    margin_grad: Floats


class _Pooling(NamedTuple):
    """What a pooled network has more: its shared layers, and memory for their outputs and gradients (`RowEncoder`).

    `delta_encoded` and `delta_hidden` `[rows, width]` are the gradients with respect to the two layers' outputs.
    """

    online: Layers
    target: Layers
    grads: Layers
    encoder: RowEncoder
    delta_encoded: Floats
    delta_hidden: Floats


class _Hyperparameters(NamedTuple):
    """What the kernel needs of the config and of PyTorch's Adam; `target_rate` 0 copies the target by the interval."""

    double: bool
    huber: bool
    margin: float
    max_norm: float
    target_interval: int
    target_rate: float
    beta1: float
    beta2: float
    epsilon: float


class CompiledUpdates:
    """Updates of a plain or pooled network on the CPU (see `Updates`).

    Args:
      online, target: the networks; their memory is changed in place.
      optimiser: Adam over the online network's flat parameters; its state is updated as Adam would do it.
      config: of the run.
    """

    def __init__(self, online: FlatNetwork, target: FlatNetwork, optimiser: Adam, config: RunConfig) -> None:
        self._online, self._target, self._optimiser = online, target, optimiser
        self._size = config.batch_size
        use_one_blas_thread()
        shared = 2 if isinstance(online.network, PooledNetwork) else 0
        self._layers, self._target_layers = _arrays(online.layers[shared:]), _arrays(target.layers[shared:])
        self._grads = _arrays(online.grads[shared:])
        self._pooling = None
        if isinstance(online.network, PooledNetwork):
            layers = _arrays(online.layers[:shared])
            encoder = make_row_encoder(self._size, online.network.shape[0], layers)
            deltas = np.zeros_like(encoder.encoded), np.zeros_like(encoder.hidden)
            others = _arrays(target.layers[:shared]), _arrays(online.grads[:shared])
            self._pooling = _Pooling(layers, *others, encoder, *deltas)
        self._hyper = _Hyperparameters(
            double=config.algorithm == "double_dqn",
            huber=config.loss == "huber",
            margin=config.teacher_margin,
            max_norm=config.max_gradient_norm,
            target_interval=config.target_update_interval,
            target_rate=config.target_update_rate if config.target_update == "soft" else 0.0,
            beta1=BETA1,
            beta2=BETA2,
            epsilon=EPSILON,
        )
        activations, other = (make_workspace(self._size, self._layers) for _ in range(2))
        td_target, grad, margin_grad = np.zeros((3, self._size), np.float32)
        rival = np.zeros(self._size, np.int64)
        self._workspace = _Workspace(activations, other, td_target, grad, rival, margin_grad)
        self._compile()

    def _compile(self) -> None:
        """Compiles the kernel for this number of layers, or loads it, before anybody waits for an update."""
        states, column, actions = np.zeros((0, 0), np.float32), np.zeros(0, np.float32), np.zeros(0, np.int64)
        batch = _SuperBatch(states, actions, column, column, states, column, actions, column)
        self._run(batch, _Flat(column, column, column, column, column), 0.0, 0, 0.0, column)

    def _run(
        self, batch: _SuperBatch, flat: _Flat, learning_rate: float, updates: int, steps: float, td_errors: Floats
    ) -> NDArray[np.float64]:
        sums = np.zeros(3)
        networks = (self._layers, self._target_layers, self._grads)
        workspace, hyper = self._workspace, self._hyper
        numbers = (learning_rate, updates, steps)
        _updates(batch, *networks, self._pooling, flat, workspace, hyper, *numbers, td_errors, sums)
        return sums

    def __call__(self, columns: dict[str, Tensor], learning_rate: float, updates: int) -> tuple[UpdateStats, Floats]:
        """See `Updates`."""
        state, count = self._optimiser.state, len(columns["action"])
        batch = _SuperBatch(
            s_tm1=columns["observation"].flatten(1).numpy(),
            a_tm1=columns["action"].numpy(),
            r_t=columns["reward"].numpy(),
            discount_t=columns["discount"].numpy(),
            s_t=columns["next_observation"].flatten(1).numpy(),
            weight=columns["weight"].numpy() if "weight" in columns else np.ones(count, np.float32),
            teacher=columns["teacher"].numpy() if "teacher" in columns else np.zeros(count, np.int64),
            teacher_weight=columns["teacher_weight"].numpy() if "teacher" in columns else np.zeros(count, np.float32),
        )
        grad = self._online.values.grad
        assert grad is not None
        tensors = (self._online.values, grad, state["exp_avg"], state["exp_avg_sq"], self._target.values)
        td_errors = np.empty(count, np.float32)
        flat = _Flat(*(tensor.detach().numpy() for tensor in tensors))
        sums = self._run(batch, flat, learning_rate, updates, float(state["step"]), td_errors)
        made = count // self._size
        state["step"] += made
        return UpdateStats(*(sums / made).tolist()), td_errors


def _arrays(layers: list[tuple[Tensor, Tensor]]) -> Layers:
    weights, biases = zip(*layers, strict=True)
    return Layers(tuple(weight.numpy() for weight in weights), tuple(bias.numpy() for bias in biases))


@kernel
def _updates(
    batch: _SuperBatch,
    online: Layers,
    target: Layers,
    grads: Layers,
    pooling: _Pooling | None,
    flat: _Flat,
    workspace: _Workspace,
    hyper: _Hyperparameters,
    learning_rate: float,
    updates: int,
    steps: float,
    td_errors: Floats,
    sums: NDArray[np.float64],
) -> None:
    """Makes one update of each minibatch in turn.

    Args:
      batch: minibatch after minibatch.
      online, target, grads: views of `flat`, layer by layer, without the shared layers of a pooled network.
      pooling: those; None for a plain network.
      flat: see _Flat; changed in place.
      workspace: see _Workspace.
      hyper: see _Hyperparameters.
      learning_rate: Adam's.
      updates, steps: updates of the learner, and steps of Adam, before this call.
      td_errors: receives the TD errors `[rows]`, each before its update.
      sums: the sums of loss, mean action value and mean absolute TD error over the minibatches are added to it.
    """
    size = len(workspace.td_target)
    for start in range(0, len(td_errors), size):
        _td_targets(batch, start, online, target, pooling, workspace, hyper.double)
        _forward_online(batch.s_tm1, start, online, pooling, workspace.online)
        _losses(batch, start, workspace, hyper.huber, td_errors, sums)
        _margin_losses(batch, start, workspace, np.float32(hyper.margin), sums)
        _backward(batch, start, online, grads, workspace)
        if pooling is not None:
            _pooling_backward(online, pooling, workspace)
        updates, steps = updates + 1, steps + 1.0
        _adam_step(flat, hyper, learning_rate, steps)
        if hyper.target_rate > 0:
            _polyak(flat.target, flat.values, np.float32(hyper.target_rate))
        elif updates % hyper.target_interval == 0:
            _polyak(flat.target, flat.values, np.float32(1))


@inlined
def _forward(states: Floats, start: int, layers: Layers, activations: tuple[Floats, ...]) -> None:
    """Copies a minibatch's states to `activations[0]`, and computes all layers from them."""
    for row in range(activations[0].shape[0]):
        for column in range(activations[0].shape[1]):
            activations[0][row, column] = states[start + row, column]
    forward(layers, activations)


@inlined
def _forward_online(
    states: Floats, start: int, online: Layers, pooling: _Pooling | None, activations: tuple[Floats, ...]
) -> None:
    if pooling is None:
        _forward(states, start, online, activations)
    else:
        encode_rows(states, start, pooling.online, pooling.encoder, activations[0])
        forward(online, activations)


@inlined
def _td_targets(
    batch: _SuperBatch,
    start: int,
    online: Layers,
    target: Layers,
    pooling: _Pooling | None,
    workspace: _Workspace,
    double: bool,
) -> None:
    """Writes the TD targets of a minibatch (see `learner.update.double_dqn.td_targets`)."""
    if pooling is None:
        _forward(batch.s_t, start, target, workspace.other)
    else:
        encode_rows(batch.s_t, start, pooling.target, pooling.encoder, workspace.other[0])
        forward(target, workspace.other)
    q_t = workspace.other[-1]
    selector = q_t
    if double:
        _forward_online(batch.s_t, start, online, pooling, workspace.online)
        selector = workspace.online[-1]
    for row in range(len(workspace.td_target)):
        best = best_action(selector, row)
        workspace.td_target[row] = batch.r_t[start + row] + batch.discount_t[start + row] * q_t[row, best]


@inlined
def _losses(
    batch: _SuperBatch, start: int, workspace: _Workspace, huber: bool, td_errors: Floats, sums: NDArray[np.float64]
) -> None:
    """Writes TD errors, and the gradient of the mean loss (see `mean_loss`) w.r.t. the taken actions' values."""
    q_tm1, size = workspace.online[-1], len(workspace.td_target)
    one, half, two = np.float32(1), np.float32(0.5), np.float32(2)
    loss_sum, value_sum, error_sum = 0.0, 0.0, 0.0
    for row in range(size):
        td_error = workspace.td_target[row] - q_tm1[row, batch.a_tm1[start + row]]
        weight = batch.weight[start + row]
        if huber:
            grad = one if td_error > one else (-one if td_error < -one else td_error)
            loss = grad * (td_error - half * grad)
        else:
            grad = two * td_error
            loss = td_error * td_error
        loss_sum += weight * loss
        workspace.grad[row] = -weight * grad / np.float32(size)
        error_sum += abs(td_error)
        td_errors[start + row] = td_error
        for action in range(q_tm1.shape[1]):
            value_sum += q_tm1[row, action]
    sums[0] += loss_sum / size
    sums[1] += value_sum / q_tm1.size
    sums[2] += error_sum / size


@inlined
def _margin_losses(
    batch: _SuperBatch, start: int, workspace: _Workspace, margin: np.float32, sums: NDArray[np.float64]
) -> None:
    """Writes the rivals of the teacher's actions and the gradients of their losses (see `margin_losses`)."""
    q_tm1, size = workspace.online[-1], len(workspace.td_target)
    loss_sum = 0.0
    for row in range(size):
        workspace.margin_grad[row] = np.float32(0)
        teacher, weight = batch.teacher[start + row], batch.teacher_weight[start + row]
        if weight == np.float32(0):
            continue
        rival = 0
        for action in range(1, q_tm1.shape[1]):
            lead = q_tm1[row, rival] + (margin if rival != teacher else np.float32(0))
            if q_tm1[row, action] + (margin if action != teacher else np.float32(0)) > lead:
                rival = action
        if rival != teacher:
            workspace.rival[row], workspace.margin_grad[row] = rival, weight / np.float32(size)
            loss_sum += weight * (q_tm1[row, rival] + margin - q_tm1[row, teacher])
    sums[0] += loss_sum / size


@inlined
def _backward(batch: _SuperBatch, start: int, online: Layers, grads: Layers, workspace: _Workspace) -> None:
    """Backpropagates `workspace.grad` to `grads`; the hidden layers' gradients go to `workspace.other`."""
    last = len(online.weights) - 1
    _head_backward(batch, start, online, grads, workspace)
    for i in range(last - 1, -1, -1):
        delta, inputs = workspace.other[i + 1], workspace.online[i]
        _sum_rows(delta, grads.biases[i])
        multiply(delta.T, inputs, grads.weights[i])
        if i > 0:
            multiply(delta, online.weights[i], workspace.other[i])
            _relu_backward(workspace.other[i], inputs)


@inlined
def _pooling_backward(online: Layers, pooling: _Pooling, workspace: _Workspace) -> None:
    """Backpropagates to the shared layers: each unit's gradient goes to the row that had the maximum."""
    encoder, grads, delta = pooling.encoder, pooling.grads, workspace.other[0]
    if len(online.weights) > 1:  # else the head has written it
        multiply(workspace.other[1], online.weights[0], delta)
    count, columns = encoder.first[-1], encoder.rows.shape[1]
    encoded, hidden = pooling.delta_encoded[:count], pooling.delta_hidden[:count]
    encoded[:] = np.float32(0)
    for i in range(encoder.winner.shape[0]):
        for unit in range(encoder.winner.shape[1]):
            if encoder.winner[i, unit] >= 0:
                encoded[encoder.winner[i, unit], unit] = delta[i, columns + unit]
    _sum_rows(encoded, grads.biases[1])
    multiply(encoded.T, encoder.hidden[:count], grads.weights[1])
    multiply(encoded, pooling.online.weights[1], hidden)
    _relu_backward(hidden, encoder.hidden[:count])
    _sum_rows(hidden, grads.biases[0])
    multiply(hidden.T, encoder.rows[:count], grads.weights[0])


@inlined
def _head_backward(batch: _SuperBatch, start: int, online: Layers, grads: Layers, workspace: _Workspace) -> None:
    """Writes the last layer's gradients, and the gradient with respect to its inputs."""
    last = len(online.weights) - 1
    weight, weight_grad, bias_grad = online.weights[last], grads.weights[last], grads.biases[last]
    inputs, delta = workspace.online[last], workspace.other[last]
    weight_grad[:] = np.float32(0)
    bias_grad[:] = np.float32(0)
    for row in range(inputs.shape[0]):
        grad, action = workspace.grad[row], batch.a_tm1[start + row]
        bias_grad[action] += grad
        for column in range(inputs.shape[1]):
            weight_grad[action, column] += grad * inputs[row, column]
            delta[row, column] = grad * weight[action, column]
        margin_grad, rival, teacher = workspace.margin_grad[row], workspace.rival[row], batch.teacher[start + row]
        if margin_grad != np.float32(0):
            bias_grad[rival] += margin_grad
            bias_grad[teacher] -= margin_grad
            for column in range(inputs.shape[1]):
                weight_grad[rival, column] += margin_grad * inputs[row, column]
                weight_grad[teacher, column] -= margin_grad * inputs[row, column]
                delta[row, column] += margin_grad * (weight[rival, column] - weight[teacher, column])
    _relu_backward(delta, inputs)


@inlined
def _relu_backward(delta: Floats, activations: Floats) -> None:
    """Zeroes the gradient `delta`, in place, where ReLU is inactive."""
    zero = np.float32(0)
    for row in range(delta.shape[0]):
        for column in range(delta.shape[1]):
            delta[row, column] = zero if activations[row, column] <= zero else delta[row, column]


@inlined
def _sum_rows(delta: Floats, total: Floats) -> None:
    """Writes the sum of `delta` `[batch, width]` over the batch to `total` `[width]`."""
    total[:] = np.float32(0)
    for row in range(delta.shape[0]):
        for column in range(delta.shape[1]):
            total[column] += delta[row, column]


@inlined
def _adam_step(flat: _Flat, hyper: _Hyperparameters, learning_rate: float, steps: float) -> None:
    """Clips the gradients to `max_norm`, as PyTorch does, and makes Adam's step (Kingma and Ba 2015, Algorithm 1)."""
    one = np.float32(1)
    norm = np.sqrt(squared_norm(flat.grads))
    scale = np.float32(hyper.max_norm) / (norm + np.float32(1e-6))
    scale = one if scale > one else scale
    weight1, weight2 = np.float32(1 - hyper.beta1), np.float32(1 - hyper.beta2)
    step_size = np.float32(learning_rate / (1 - hyper.beta1**steps))
    correction2_sqrt = np.float32(np.sqrt(1 - hyper.beta2**steps))
    epsilon = np.float32(hyper.epsilon)
    for i in range(len(flat.grads)):
        grad = flat.grads[i] * scale
        flat.grads[i] = grad
        flat.exp_avg[i] += weight1 * (grad - flat.exp_avg[i])
        flat.exp_avg_sq[i] += weight2 * (grad * grad - flat.exp_avg_sq[i])
        flat.values[i] -= step_size * flat.exp_avg[i] / (np.sqrt(flat.exp_avg_sq[i]) / correction2_sqrt + epsilon)


@inlined
def _polyak(target: Floats, online: Floats, rate: np.float32) -> None:
    """Polyak averaging, in place: target = (1 - rate) target + rate online; rate 1 copies."""
    rest = np.float32(1) - rate
    for i in range(len(target)):
        target[i] = rest * target[i] + rate * online[i]
