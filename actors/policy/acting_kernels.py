"""A multilayer perceptron for acting, in numba: what it says of an observation depends on no other one of the batch.

Of every layer's inputs only those count that are not 0: of M_sensor's counts a quarter, after a ReLU about a half. BLAS
multiplies by the zeros, too, and its sums may depend on the size of the batch.

Weights stand in blocks of so many outputs that a block stays in the processor's first cache while a tile of
observations passes through it.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.policy.mlp_kernels import Floats, best_action
from sim_core.jit import inlined, kernel
from sim_core.lanes import WIDE, load_wide, select, store_numbers, store_wide

TILE = 16
"""Observations that pass through the layers together."""
BLOCK = 4 * WIDE
"""Outputs of a block of weights; where a layer has at most `WIDE`, as a last one does, they are one block."""
AHEAD = 4
"""Inputs that are added at once."""


class ActingLayer(NamedTuple):
    """A layer's weights `[blocks, inputs + 1, outputs of a block]` and biases `[blocks * outputs of a block]`, float32.

    Inputs and outputs are padded with zeros to multiples of 16 and of a block; the last input is 0, too.
    """

    weights: Floats
    bias: Floats


class ActingTile(NamedTuple):
    """Memory for a tile.

    values: two of `[TILE, most inputs + 1]` float32, the inputs of a layer and its outputs, padded to wide vectors.
    places: `[TILE, most inputs + 16 + AHEAD]` int32, which inputs are not 0. counts: `[TILE]` int32, how many.
    rows: `[TILE]` int64, where in the batch the observations are. num_actions: `[1]` int64.
    """

    values: tuple[Floats, Floats]
    places: NDArray[np.int32]
    counts: NDArray[np.int32]
    rows: NDArray[np.int64]
    num_actions: NDArray[np.int64]


def _padded(size: int, multiple: int) -> int:
    return -(-size // multiple) * multiple


def _zeros(*shape: int) -> Floats:
    """Zeros float32 that begin where a line of the processor's cache does, so that no wide vector lies in two."""
    line_bytes, count = 64, math.prod(shape)
    memory = np.zeros(4 * count + line_bytes, np.uint8)
    begin = -memory.ctypes.data % line_bytes
    return memory[begin : begin + 4 * count].view(np.float32).reshape(shape)


def acting_layer(weights: Floats, bias: Floats) -> ActingLayer:
    """A layer of weights `[fan_out, fan_in]` and bias `[fan_out]`."""
    fan_out, fan_in = weights.shape
    block = WIDE if fan_out <= WIDE else BLOCK
    outputs, inputs = _padded(fan_out, block), _padded(fan_in, WIDE)
    layer = ActingLayer(_zeros(outputs // block, inputs + 1, block), _zeros(outputs))
    for first in range(0, fan_out, block):
        part = weights[first : first + block]
        layer.weights[first // block, :fan_in, : len(part)] = part.T
    layer.bias[:fan_out] = bias
    return layer


def acting_tile(layers: tuple[ActingLayer, ...], num_actions: int) -> ActingTile:
    """The memory that these layers need; the last one has so many outputs, without its padding."""
    most = max(max(layer.weights.shape[1], len(layer.bias) + 1) for layer in layers)
    most = _padded(most, WIDE)
    return ActingTile(
        values=(_zeros(TILE, most), _zeros(TILE, most)),
        places=np.zeros((TILE, most + WIDE + AHEAD), np.int32),
        counts=np.zeros(TILE, np.int32),
        rows=np.zeros(TILE, np.int64),
        num_actions=np.array([num_actions]),
    )


@inlined
def _find_inputs(rows: int, inputs: int, values: Floats, tile: ActingTile) -> None:
    """Lists the inputs that are not 0 (NaN is not); the list ends with the input that always is."""
    zero = np.float32(0)
    values_width, places_width = values.shape[1], tile.places.shape[1]
    for row in range(rows):
        values[row, inputs] = zero
        count = 0
        for first in range(0, inputs, WIDE):
            x = load_wide(values, (row * values_width + first) // WIDE)
            is_input = ~(x == zero)
            count += store_numbers(tile.places, row * places_width + count, is_input, first)
        for i in range(AHEAD):
            tile.places[row, count + i] = inputs
        tile.counts[row] = count


@inlined
def _rectified(x: Any, rectify: bool) -> Any:
    """ReLU if `rectify`; NaN stays NaN."""
    zero = np.float32(0)
    return select(x <= zero, zero, x) if rectify else x


@inlined
def _wide_block(
    block: int, rows: int, layer: ActingLayer, values: Floats, tile: ActingTile, out: Floats, rectify: bool
) -> None:
    """Computes 64 outputs of every row."""
    inputs, out_width = layer.weights.shape[1], out.shape[1] // WIDE
    for row in range(rows):
        a, b = load_wide(layer.bias, 4 * block), load_wide(layer.bias, 4 * block + 1)
        c, d = load_wide(layer.bias, 4 * block + 2), load_wide(layer.bias, 4 * block + 3)
        for i in range(0, tile.counts[row], 2):
            j, k = tile.places[row, i], tile.places[row, i + 1]
            x, y = values[row, j], values[row, k]
            at, after = 4 * (block * inputs + j), 4 * (block * inputs + k)
            a = a + (x * load_wide(layer.weights, at) + y * load_wide(layer.weights, after))
            b = b + (x * load_wide(layer.weights, at + 1) + y * load_wide(layer.weights, after + 1))
            c = c + (x * load_wide(layer.weights, at + 2) + y * load_wide(layer.weights, after + 2))
            d = d + (x * load_wide(layer.weights, at + 3) + y * load_wide(layer.weights, after + 3))
        begin = row * out_width + 4 * block
        store_wide(out, begin, _rectified(a, rectify))
        store_wide(out, begin + 1, _rectified(b, rectify))
        store_wide(out, begin + 2, _rectified(c, rectify))
        store_wide(out, begin + 3, _rectified(d, rectify))


@inlined
def _narrow_block(rows: int, layer: ActingLayer, values: Floats, tile: ActingTile, out: Floats, rectify: bool) -> None:
    """Computes the 16 outputs of a narrow layer of every row."""
    out_width = out.shape[1] // WIDE
    for row in range(rows):
        total = load_wide(layer.bias, 0)
        for i in range(0, tile.counts[row], AHEAD):
            j, k, m, n = tile.places[row, i], tile.places[row, i + 1], tile.places[row, i + 2], tile.places[row, i + 3]
            first = values[row, j] * load_wide(layer.weights, j) + values[row, k] * load_wide(layer.weights, k)
            second = values[row, m] * load_wide(layer.weights, m) + values[row, n] * load_wide(layer.weights, n)
            total = total + (first + second)
        store_wide(out, row * out_width, _rectified(total, rectify))


@inlined
def _pass_tile(rows: int, layers: tuple[ActingLayer, ...], tile: ActingTile) -> int:
    """Computes all layers of a tile from `tile.values[0]`; returns the number of the array that has the last one."""
    last = len(layers) - 1
    for number in range(last + 1):
        layer, values, out = layers[number], tile.values[number % 2], tile.values[1 - number % 2]
        _find_inputs(rows, layer.weights.shape[1] - 1, values, tile)
        if layer.weights.shape[2] == WIDE:
            _narrow_block(rows, layer, values, tile, out, number < last)
        else:
            for block in range(layer.weights.shape[0]):
                _wide_block(block, rows, layer, values, tile, out, number < last)
    return (last + 1) % 2


@inlined
def _load_row(observation: NDArray[Any], row: int, tile: ActingTile, inputs: int) -> None:
    """Copies an observation, padded with zeros, into the row of a tile."""
    values = tile.values[0]
    for column in range(observation.shape[0]):
        values[row, column] = observation[column]
    for column in range(observation.shape[0], inputs):
        values[row, column] = np.float32(0)


@kernel
def action_values(layers: tuple[ActingLayer, ...], tile: ActingTile, observations: Floats, out: Floats) -> None:
    """Writes the action values `[batch, actions]` of `observations` `[batch, fan_in]`, both float32."""
    inputs = layers[0].weights.shape[1] - 1
    for first in range(0, observations.shape[0], TILE):
        rows = min(TILE, observations.shape[0] - first)
        for row in range(rows):
            _load_row(observations[first + row], row, tile, inputs)
        values = tile.values[_pass_tile(rows, layers, tile)]
        for row in range(rows):
            for action in range(out.shape[1]):
                out[first + row, action] = values[row, action]


@inlined
def _is_known(observation: Any, known: Any) -> bool:
    """Whether all elements are equal; NaN equals nothing."""
    differ = 0
    for i in range(observation.shape[0]):
        differ |= observation[i] != known[i]
    return differ == 0


@inlined
def _act(count: int, layers: tuple[ActingLayer, ...], tile: ActingTile, action: NDArray[np.int64], value: Any) -> None:
    """Writes the best actions and their values of a tile of `count` observations, the lowest index among equals."""
    values = tile.values[_pass_tile(count, layers, tile)]
    for i in range(count):
        row = tile.rows[i]
        action[row] = best_action(values[i : i + 1, : tile.num_actions[0]], 0)
        value[row] = values[i, action[row]]


@kernel
def best_actions(
    layers: tuple[ActingLayer, ...],
    tile: ActingTile,
    observations: NDArray[Any],
    known: NDArray[Any],
    decides: NDArray[np.bool_],
    action: NDArray[np.int64],
    value: Floats,
) -> None:
    """Writes the best action and its value where a row decides and its observation is another one than is known.

    Args:
      layers: ActingLayers.
      tile: their memory.
      observations: `[batch, fan_in]`.
      known: `[batch, fan_in]`, of the same dtype: the observations that `action` and `value` are of; written.
      decides: `[batch]` bool.
      action: `[batch]` int64, written.
      value: `[batch]` float32, written.
    """
    inputs, count = layers[0].weights.shape[1] - 1, 0
    for row in range(observations.shape[0]):
        if not decides[row] or _is_known(observations[row], known[row]):
            continue
        for i in range(known.shape[1]):
            known[row, i] = observations[row, i]
        _load_row(observations[row], count, tile, inputs)
        tile.rows[count] = row
        count += 1
        if count == TILE:
            _act(count, layers, tile, action, value)
            count = 0
    if count:
        _act(count, layers, tile, action, value)
