"""A multilayer perceptron in numba, at the speed of BLAS; rollout workers and the learner on the CPU share it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_core.jit import inlined, inlined_blas

Floats = NDArray[np.float32]


class Layers(NamedTuple):
    """Weights `[fan_out, fan_in]` and biases `[fan_out]` of every layer, float32."""

    weights: tuple[Floats, ...]
    biases: tuple[Floats, ...]


def make_workspace(count: int, layers: Layers) -> tuple[Floats, ...]:
    """Arrays `[count, width]` float32 for a batch of `count`: observations, hidden layers, action values."""
    widths = [layers.weights[0].shape[1], *(len(bias) for bias in layers.biases)]
    return tuple(np.zeros((count, width), np.float32) for width in widths)


@inlined_blas
def multiply(a: Floats, b: Floats, out: Floats) -> None:
    """Writes the matrix product a b to `out`."""
    np.dot(a, b, out)


@inlined_blas
def squared_norm(x: Floats) -> Any:
    """Squared Euclidean norm of the vector x."""
    return np.dot(x, x)


@inlined
def forward(layers: Layers, workspace: tuple[Floats, ...]) -> None:
    """Computes all layers, with ReLU between them, from the observations in `workspace[0]` (see `make_workspace`)."""
    last = len(layers.weights) - 1
    for i in range(last + 1):
        multiply(workspace[i], layers.weights[i].T, workspace[i + 1])
        _add_bias(workspace[i + 1], layers.biases[i], i < last)


@inlined
def _add_bias(x: Floats, bias: Floats, rectify: bool) -> None:
    """Adds `bias` `[width]` to `x` `[batch, width]` in place, then applies ReLU if `rectify`; NaN stays NaN."""
    zero = np.float32(0)
    for row in range(x.shape[0]):
        for column in range(x.shape[1]):
            value = x[row, column] + bias[column]
            x[row, column] = zero if rectify and value <= zero else value


@inlined
def best_action(values: Floats, row: int) -> Any:
    """Action of the highest value in a row of `values` `[batch, actions]`; the lowest index among equals."""
    best = 0
    for action in range(1, values.shape[1]):
        if values[row, action] > values[row, best]:
            best = action
    return best
