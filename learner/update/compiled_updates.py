"""Updates that are compiled whole: minibatch after minibatch, with neither Python nor PyTorch in between.

For a plain network on the CPU. Small networks are bound by what surrounds their arithmetic; here that is a few loops
which go over memory once, and matrix products by the BLAS that SciPy brings. It is the arithmetic of
`learner.update.gradients` and PyTorch's Adam on the same memory, with the same result to rounding, and one more
shortcut: only the taken action's value has a slope, so that the last layer needs no matrix product on the way back.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from actors.policy.mlp_kernels import Floats, Layers, best_action, forward, make_workspace, multiply, squared_norm
from learner.update.gradients import FlatNetwork
from learner.update.updates import LearnerSettings, UpdateStats
from sim_core.jit import inlined, kernel


class _Rows(NamedTuple):
    """Columns of a super-batch: states `[rows, size]`, the others `[rows]`."""

    s_tm1: Floats
    a_tm1: NDArray[np.int64]
    r_t: Floats
    discount_t: Floats
    s_t: Floats
    weight: Floats


class _Flat(NamedTuple):
    """The online network's parameters one after the other, what Adam keeps of each, and the target network's."""

    values: Floats
    slopes: Floats
    mean: Floats
    square: Floats
    target: Floats


class _Room(NamedTuple):
    """Memory of one minibatch: states, hidden layers and action values `[batch, width]`, twice; `[batch]` twice."""

    seen: tuple[Floats, ...]
    other: tuple[Floats, ...]
    goal: Floats
    slope: Floats


class _Rule(NamedTuple):
    """What the update is: settings of the run, and of PyTorch's Adam. A `soft_rate` of 0 is a copy now and then."""

    double: bool
    huber: bool
    max_norm: float
    interval: int
    soft_rate: float
    beta_mean: float
    beta_square: float
    epsilon: float


class CompiledUpdates:
    """Updates of a plain network on the CPU (see `Updates`).

    Args:
      online, target: the networks, whose memory is changed.
      optimiser: Adam over the online network's flat parameters; its state is kept as it would keep it.
      settings: of the learner.
    """

    def __init__(
        self, online: FlatNetwork, target: FlatNetwork, optimiser: torch.optim.Adam, settings: LearnerSettings
    ) -> None:
        self._online, self._target, self._optimiser = online, target, optimiser
        self._layers, self._target_layers = _arrays(online.layers), _arrays(target.layers)
        self._slopes = _arrays(online.gradients)
        self._size = settings.batch_size
        group = optimiser.param_groups[0]
        self._rule = _Rule(
            settings.double,
            settings.loss == "huber",
            settings.max_gradient_norm,
            settings.target_update_interval,
            settings.soft_target_rate or 0.0,
            group["betas"][0],
            group["betas"][1],
            group["eps"],
        )
        seen, other = (make_workspace(self._size, self._layers) for _ in range(2))
        self._room = _Room(seen, other, *np.zeros((2, self._size), np.float32))
        self._compile()

    def _compile(self) -> None:
        """Compiles for this number of layers, or loads what was compiled, before anybody waits for an update."""
        states, column = np.zeros((0, 0), np.float32), np.zeros(0, np.float32)
        rows = _Rows(states, np.zeros(0, np.int64), column, column, states, column)
        self._run(rows, _Flat(column, column, column, column, column), 0.0, 0, 0.0, column)

    def _run(self, rows: _Rows, flat: _Flat, learning_rate: float, updates: int, steps: float, errors: Floats) -> Any:
        sums = np.zeros(3)
        networks = (self._layers, self._target_layers, self._slopes)
        _updates(rows, *networks, flat, self._room, self._rule, learning_rate, updates, steps, errors, sums)
        return sums

    def __call__(self, columns: dict[str, Tensor], learning_rate: float, updates: int) -> tuple[UpdateStats, Floats]:
        """See `Updates`."""
        state = self._state()
        rows = _Rows(
            s_tm1=columns["observation"].flatten(1).numpy(),
            a_tm1=columns["action"].numpy(),
            r_t=columns["reward"].numpy(),
            discount_t=columns["discount"].numpy(),
            s_t=columns["next_observation"].flatten(1).numpy(),
            weight=columns["weight"].numpy() if "weight" in columns else np.ones(len(columns["action"]), np.float32),
        )
        gradient = self._online.values.grad
        assert gradient is not None
        tensors = (self._online.values, gradient, state["exp_avg"], state["exp_avg_sq"], self._target.values)
        errors = np.empty(len(rows.a_tm1), np.float32)
        flat = _Flat(*(tensor.detach().numpy() for tensor in tensors))
        count = len(errors) // self._size
        sums = self._run(rows, flat, learning_rate, updates, float(state["step"]), errors)
        state["step"] += count
        return UpdateStats(*(sums / count).tolist()), errors

    def _state(self) -> dict[str, Tensor]:
        """Adam's state of the parameters, as PyTorch's begins it."""
        values = self._online.values
        state: dict[str, Tensor] = self._optimiser.state[values]
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(values.data), torch.zeros_like(values.data)
        return state


def _arrays(layers: list[tuple[Tensor, Tensor]]) -> Layers:
    weights, biases = zip(*layers, strict=True)
    return Layers(tuple(weight.numpy() for weight in weights), tuple(bias.numpy() for bias in biases))


@kernel
def _updates(
    rows: _Rows,
    online: Layers,
    target: Layers,
    slopes: Layers,
    flat: _Flat,
    room: _Room,
    rule: _Rule,
    learning_rate: float,
    updates: int,
    steps: float,
    errors: Floats,
    sums: NDArray[np.float64],
) -> None:
    """Makes an update of each minibatch in turn; `errors` take the TD errors, `sums` loss, mean value, mean error."""
    size = len(room.goal)
    for start in range(0, len(errors), size):
        _goals(rows, start, online, target, room, rule.double)
        _values(rows.s_tm1, start, online, room.seen)
        _losses(rows, start, room, rule.huber, errors, sums)
        _gradients(rows.a_tm1, start, online, slopes, room)
        updates, steps = updates + 1, steps + 1.0
        _adam(flat, rule, learning_rate, steps)
        if rule.soft_rate > 0:
            _follow(flat.target, flat.values, np.float32(rule.soft_rate))
        elif updates % rule.interval == 0:
            _follow(flat.target, flat.values, np.float32(1))


@inlined
def _values(states: Floats, start: int, layers: Layers, room: tuple[Floats, ...]) -> None:
    """Writes a minibatch's states, hidden layers and action values to `room`."""
    for row in range(room[0].shape[0]):
        for column in range(room[0].shape[1]):
            room[0][row, column] = states[start + row, column]
    forward(layers, room)


@inlined
def _goals(rows: _Rows, start: int, online: Layers, target: Layers, room: _Room, double: bool) -> None:
    """Writes what the taken actions' values should be (see `double_q_target`, `q_target`)."""
    _values(rows.s_t, start, target, room.other)
    q_t = room.other[-1]
    chooser = q_t
    if double:
        _values(rows.s_t, start, online, room.seen)
        chooser = room.seen[-1]
    for row in range(len(room.goal)):
        best = best_action(chooser, row)
        room.goal[row] = rows.r_t[start + row] + rows.discount_t[start + row] * q_t[row, best]


@inlined
def _losses(rows: _Rows, start: int, room: _Room, huber: bool, errors: Floats, sums: NDArray[np.float64]) -> None:
    """Writes TD errors, and the mean loss's slope by each taken action's value (see `mean_loss`)."""
    q_tm1, size = room.seen[-1], len(room.goal)
    one, half, two = np.float32(1), np.float32(0.5), np.float32(2)
    loss, value, size_of_error = 0.0, 0.0, 0.0
    for row in range(size):
        error = room.goal[row] - q_tm1[row, rows.a_tm1[start + row]]
        weight = rows.weight[start + row]
        if huber:
            slope = one if error > one else (-one if error < -one else error)
            lost = slope * (error - half * slope)
        else:
            slope = two * error
            lost = error * error
        loss += weight * lost
        room.slope[row] = -weight * slope / np.float32(size)
        size_of_error += abs(error)
        errors[start + row] = error
        for action in range(q_tm1.shape[1]):
            value += q_tm1[row, action]
    sums[0] += loss / size
    sums[1] += value / q_tm1.size
    sums[2] += size_of_error / size


@inlined
def _gradients(actions: NDArray[np.int64], start: int, online: Layers, slopes: Layers, room: _Room) -> None:
    """Back-propagates `room.slope`; the loss's derivatives by the hidden layers go to `room.other`."""
    last = len(online.weights) - 1
    _head_gradients(actions, start, online, slopes, room)
    for i in range(last - 1, -1, -1):
        delta, inputs = room.other[i + 1], room.seen[i]
        _add_up(delta, slopes.biases[i])
        multiply(delta.T, inputs, slopes.weights[i])
        if i > 0:
            multiply(delta, online.weights[i], room.other[i])
            _stop_where_idle(room.other[i], inputs)


@inlined
def _head_gradients(actions: NDArray[np.int64], start: int, online: Layers, slopes: Layers, room: _Room) -> None:
    """The last layer's gradients, and the derivatives by its inputs."""
    last = len(online.weights) - 1
    weight, weight_slope, bias_slope = online.weights[last], slopes.weights[last], slopes.biases[last]
    inputs, delta = room.seen[last], room.other[last]
    weight_slope[:] = np.float32(0)
    bias_slope[:] = np.float32(0)
    for row in range(inputs.shape[0]):
        slope, action = room.slope[row], actions[start + row]
        bias_slope[action] += slope
        for column in range(inputs.shape[1]):
            weight_slope[action, column] += slope * inputs[row, column]
            delta[row, column] = slope * weight[action, column]
    _stop_where_idle(delta, inputs)


@inlined
def _stop_where_idle(delta: Floats, inputs: Floats) -> None:
    """Zero where the hidden unit is at its zero: ReLU's slope."""
    zero = np.float32(0)
    for row in range(delta.shape[0]):
        for column in range(delta.shape[1]):
            delta[row, column] = zero if inputs[row, column] <= zero else delta[row, column]


@inlined
def _add_up(delta: Floats, total: Floats) -> None:
    """The sum over rows."""
    total[:] = np.float32(0)
    for row in range(delta.shape[0]):
        for column in range(delta.shape[1]):
            total[column] += delta[row, column]


@inlined
def _adam(flat: _Flat, rule: _Rule, learning_rate: float, steps: float) -> None:
    """Scales the gradients down to `max_norm`, as PyTorch does, and makes Adam's step of them."""
    one = np.float32(1)
    norm = np.sqrt(squared_norm(flat.slopes))
    scale = np.float32(rule.max_norm) / (norm + np.float32(1e-6))
    scale = one if scale > one else scale
    share_mean, share_square = np.float32(1 - rule.beta_mean), np.float32(1 - rule.beta_square)
    length = np.float32(learning_rate / (1 - rule.beta_mean**steps))
    root = np.float32(np.sqrt(1 - rule.beta_square**steps))
    epsilon = np.float32(rule.epsilon)
    for i in range(len(flat.slopes)):
        slope = flat.slopes[i] * scale
        flat.slopes[i] = slope
        flat.mean[i] += share_mean * (slope - flat.mean[i])
        flat.square[i] += share_square * (slope * slope - flat.square[i])
        flat.values[i] -= length * flat.mean[i] / (np.sqrt(flat.square[i]) / root + epsilon)


@inlined
def _follow(target: Floats, online: Floats, rate: np.float32) -> None:
    """Polyak's average; at rate 1 a copy."""
    rest = np.float32(1) - rate
    for i in range(len(target)):
        target[i] = rest * target[i] + rate * online[i]
