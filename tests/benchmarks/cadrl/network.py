"""The network of GA3C-CADRL-10 (Everett, Chen and How, IROS 2018) in numpy: an LSTM over the other robots, then layers.

Weights are read from the package `gym-collision-avoidance` (MIT licence), wherever Python finds it; nothing of it is
imported.
"""

import importlib.util
import math
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.cadrl.checkpoint import read_arrays

PACKAGE = "gym_collision_avoidance"
CHECKPOINT = "envs/policies/GA3C_CADRL/checkpoints/IROS18/network_01900000"
"""The policy that its authors' tests call GA3C-CADRL-10, with up to 19 other robots, the nearest last."""
MOST_OTHERS, OTHER_VALUES, OWN_VALUES = 19, 7, 4
INPUTS = 1 + OWN_VALUES + MOST_OTHERS * OTHER_VALUES
"""Number of other robots; distance to the goal, heading from its direction, preferred speed, radius; and for each
other robot position and velocity along and across the goal's direction, radius, sum of the radii, gap."""
OWN_MEAN, OWN_SCALE = (0.0, 0.0, 1.0, 0.5), (5.0, 3.14, 1.0, 1.0)
OTHER_MEAN, OTHER_SCALE = (0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 1.0), (5.0, 5.0, 1.0, 1.0, 1.0, 5.0, 1.0)
SPEEDS = np.array([1.0] * 5 + [0.5] * 3 + [0.0] * 3, np.float32)
"""Of the actions, as shares of the preferred speed."""
TURNS_RAD = np.array([-2, -1, 0, 1, 2, -2, 0, 2, -2, 0, 2], np.float32) * np.float32(math.pi / 12)
"""Of the actions, from the present heading."""


class Weights(NamedTuple):
    """Kernels `[inputs, units]` and biases `[units]`, float32; the LSTM's units are input, new, forget and output."""

    lstm: tuple[NDArray[np.float32], NDArray[np.float32]]
    layers: tuple[tuple[NDArray[np.float32], NDArray[np.float32]], ...]
    logits: tuple[NDArray[np.float32], NDArray[np.float32]]


def checkpoint_path() -> Path:
    """Where the published weights are.

    Raises:
      ModuleNotFoundError: Python does not find the package.
    """
    spec = importlib.util.find_spec(PACKAGE)
    if spec is None or not spec.submodule_search_locations:
        raise ModuleNotFoundError(f"no package {PACKAGE}")
    return Path(spec.submodule_search_locations[0]) / CHECKPOINT


@cache
def published_weights() -> Weights:
    """The published weights; see `checkpoint_path` for errors."""
    arrays = read_arrays(checkpoint_path())

    def layer(name: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        return arrays[f"{name}/kernel:0"], arrays[f"{name}/bias:0"]

    names = ("layer1", "layer2", "fullyconnected1")
    return Weights(layer("rnn/lstm_cell"), tuple(map(layer, names)), layer("logits_p"))


def action_logits(observation: NDArray[np.float32], weights: Weights) -> NDArray[np.float32]:
    """Logits `[batch, 11]` of the actions for observations `[batch, 138]`, in metres, m/s and radians."""
    count = observation[:, 0].astype(np.int64)
    own = (observation[:, 1 : 1 + OWN_VALUES] - np.float32(OWN_MEAN)) / np.float32(OWN_SCALE)
    others = observation[:, 1 + OWN_VALUES :].reshape(len(observation), MOST_OTHERS, OTHER_VALUES)
    x = np.concatenate(
        [own, _last_hidden((others - np.float32(OTHER_MEAN)) / np.float32(OTHER_SCALE), count, weights)], 1
    )
    for kernel, bias in weights.layers:
        x = np.maximum(x @ kernel + bias, 0)
    kernel, bias = weights.logits
    return x @ kernel + bias


def _last_hidden(others: NDArray[np.float32], count: NDArray[np.int64], weights: Weights) -> NDArray[np.float32]:
    """The LSTM's output `[batch, units]` after the first `count` `[batch]` of the others `[batch, 19, 7]`."""
    kernel, bias = weights.lstm
    units = len(bias) // 4
    hidden = cell = np.zeros((len(others), units), np.float32)
    for place in range(int(count.max(initial=0))):
        gates = np.concatenate([others[:, place], hidden], axis=1) @ kernel + bias
        enter, new, forget, leave = np.split(gates, 4, axis=1)
        next_cell = cell * _sigmoid(forget + 1) + _sigmoid(enter) * np.tanh(new)
        there = (place < count)[:, None]
        hidden = np.where(there, np.tanh(next_cell) * _sigmoid(leave), hidden)
        cell = np.where(there, next_cell, cell)
    return hidden


def _sigmoid(x: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.float32(0.5) * (np.tanh(np.float32(0.5) * x) + np.float32(1))
