"""A counter-like random stream per world, as plain state that a checkpoint can hold.

SplitMix64 (Steele, Lea, Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014): one
uint64 of state a world. Draws of one world never depend on how worlds are batched.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_core.jit import kernel

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_SHIFT_30, _SHIFT_27, _SHIFT_31, _SHIFT_11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_TO_UNIT = 1.0 / 9007199254740992.0


@kernel
def uniform_after(state, draws):
    """The float64 in [0, 1) that `draws` (1 or more) draws from now gives, of a stream's uint64 `state`."""
    z = state + np.uint64(draws) * _GOLDEN
    z = (z ^ (z >> _SHIFT_30)) * _MIX_1
    z = (z ^ (z >> _SHIFT_27)) * _MIX_2
    z = z ^ (z >> _SHIFT_31)
    return np.float64(z >> _SHIFT_11) * _TO_UNIT


@kernel
def skip(state, world, draws):
    """Moves the stream `state[world]` on by `draws` draws."""
    state[world] += np.uint64(draws) * _GOLDEN


@kernel
def uniform(state, world):
    """Next float64 in [0, 1) of `state[world]` (uint64 `[num_worlds]`), which moves on by one draw."""
    value = uniform_after(state[world], 1)
    skip(state, world, 1)
    return value


@kernel
def fill_uniform(state, world, out):
    """Writes the next draws of `state[world]` to `out` `[count]` float64, each in [0, 1)."""
    for i in range(out.shape[0]):
        out[i] = uniform(state, world)


def world_streams(seed: int, num_worlds: int) -> NDArray[np.uint64]:
    """Independent initial states `[num_worlds]` uint64 for worlds of one batch."""
    return np.random.SeedSequence(seed).generate_state(num_worlds, dtype=np.uint64).astype(np.uint64)
