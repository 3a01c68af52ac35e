"""A multilayer perceptron in numba: what acts and what learns on the CPU compute alike, at BLAS's speed."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_core.jit import inlined, inlined_blas

Floats = NDArray[np.float32]


class Layers(NamedTuple):
    """Weights `[fan_out, fan_in]` and biases `[fan_out]` of all layers, float32."""

    weights: tuple[Floats, ...]
    biases: tuple[Floats, ...]


def make_room(count: int, layers: Layers) -> tuple[Floats, ...]:
    """Memory for `count` observations: them, the hidden layers and the action values, `[count, width]` each."""
    widths = [layers.weights[0].shape[1], *(len(bias) for bias in layers.biases)]
    return tuple(np.zeros((count, width), np.float32) for width in widths)


@inlined_blas
def multiply(a: Floats, b: Floats, out: Floats) -> None:
    """The matrix product a b, written to `out`."""
    np.dot(a, b, out)


@inlined_blas
def squared_norm(x: Floats) -> Any:
    """The scalar product of x with itself."""
    return np.dot(x, x)


@inlined
def forward(layers: Layers, room: tuple[Floats, ...]) -> None:
    """Computes all layers, ReLU between them, from the observations in `room[0]`."""
    last = len(layers.weights) - 1
    for i in range(last + 1):
        multiply(room[i], layers.weights[i].T, room[i + 1])
        _shift(room[i + 1], layers.biases[i], i < last)


@inlined
def _shift(x: Floats, bias: Floats, rectify: bool) -> None:
    """Adds the bias in place; if it rectifies, what is below 0 becomes 0, and NaN stays NaN."""
    zero = np.float32(0)
    for row in range(x.shape[0]):
        for column in range(x.shape[1]):
            value = x[row, column] + bias[column]
            x[row, column] = zero if rectify and value <= zero else value


@inlined
def best_of(values: Floats, row: int) -> Any:
    """The best action of a row `[batch, actions]`; the lowest index among equals."""
    best = 0
    for action in range(1, values.shape[1]):
        if values[row, action] > values[row, best]:
            best = action
    return best
