"""A multilayer perceptron in numba, at the speed of BLAS; rollout workers and the learner on the CPU share it."""

from __future__ import annotations

import functools
import importlib
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from sim_core.jit import inlined, inlined_blas

Floats = NDArray[np.float32]


class Layers(NamedTuple):
    """Weights `[fan_out, fan_in]` and biases `[fan_out]` of every layer, float32."""

    weights: tuple[Floats, ...]
    biases: tuple[Floats, ...]


@functools.cache
def use_one_blas_thread() -> None:
    """Has BLAS multiply with one thread in this process from now on: with more, products differ in their last bits.

    The number of threads would otherwise depend on who has imported SciPy before, and with it what a run learns.
    """
    importlib.import_module("scipy.linalg.cython_blas")  # whose BLAS numba calls; only a loaded one can be limited
    threadpool_limits(1, "blas")


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


class RowEncoder(NamedTuple):
    """Memory of the shared layers of a pooled network (see `actors.policy.network.PooledNetwork`).

    All rows of the other groups of a batch stand one after the other, without the absent ones. `rows` `[rows, columns]`
    are their elements, `hidden` and `encoded` `[rows, width]` the two layers' outputs, `first` `[batch + 1]` int64 the
    first row of every observation, `winner` `[batch, width]` int64 the row with the largest output, -1 where none is
    above 0.
    """

    rows: Floats
    hidden: Floats
    encoded: Floats
    first: NDArray[np.int64]
    winner: NDArray[np.int64]


def make_row_encoder(count: int, num_rows: int, layers: Layers) -> RowEncoder:
    """Memory for a batch of `count` observations of `num_rows` rows; `layers` are the two shared ones."""
    columns, width, most = layers.weights[0].shape[1], len(layers.biases[1]), count * (num_rows - 1)
    return RowEncoder(
        rows=np.zeros((most, columns), np.float32),
        hidden=np.zeros((most, len(layers.biases[0])), np.float32),
        encoded=np.zeros((most, width), np.float32),
        first=np.zeros(count + 1, np.int64),
        winner=np.zeros((count, width), np.int64),
    )


@inlined
def encode_rows(observations: Floats, start: int, layers: Layers, encoder: RowEncoder, out: Floats) -> None:
    """Encodes the rows of a batch: `out` gets the first row, then the maximum over the encoded other rows.

    Args:
      observations: `[total, rows * columns]`, of which the batch begins at `start`. A row of zeros is absent.
      layers: the two shared layers.
      encoder: memory; changed in place.
      out: `[batch, columns + width]`.
    """
    columns, width = encoder.rows.shape[1], encoder.encoded.shape[1]
    count = 0
    for i in range(out.shape[0]):
        encoder.first[i] = count
        for column in range(columns):
            out[i, column] = observations[start + i, column]
        for begin in range(columns, observations.shape[1], columns):
            if observations[start + i, begin] == np.float32(0):  # no half-axis of a group is 0
                continue
            for column in range(columns):
                encoder.rows[count, column] = observations[start + i, begin + column]
            count += 1
    encoder.first[out.shape[0]] = count
    multiply(encoder.rows[:count], layers.weights[0].T, encoder.hidden[:count])
    _add_bias(encoder.hidden[:count], layers.biases[0], True)
    multiply(encoder.hidden[:count], layers.weights[1].T, encoder.encoded[:count])
    _add_bias(encoder.encoded[:count], layers.biases[1], True)
    for i in range(out.shape[0]):
        for unit in range(width):
            best, winner = np.float32(0), -1
            for row in range(encoder.first[i], encoder.first[i + 1]):
                if not encoder.encoded[row, unit] <= best:  # NaN wins, so that divergence shows
                    best, winner = encoder.encoded[row, unit], row
            out[i, columns + unit] = best
            encoder.winner[i, unit] = winner


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
