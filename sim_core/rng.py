"""One random stream per world, whose whole state is a uint64 that a checkpoint can hold.

SplitMix64 (Steele, Lea, Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014). The state is a
counter, so any later draw can be computed without those before it. The draws of a world do not depend on the batch
that the world is in.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_core.jit import kernel

_GOLDEN_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_SHIFT_30, _SHIFT_27, _SHIFT_31, _SHIFT_11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_TO_UNIT = 1.0 / 9007199254740992.0


@kernel
def uniform_at(state, draw):
    """Draw number `draw` (from 1) after the stream's uint64 `state`: a float64 in [0, 1). The state stays."""
    z = state + np.uint64(draw) * _GOLDEN_GAMMA
    z = (z ^ (z >> _SHIFT_30)) * _MIX_1
    z = (z ^ (z >> _SHIFT_27)) * _MIX_2
    z = z ^ (z >> _SHIFT_31)
    return np.float64(z >> _SHIFT_11) * _TO_UNIT


@kernel
def skip_ahead(state, world, draws):
    """Advances the stream `state[world]` (uint64 `[num_worlds]`) by `draws` draws."""
    state[world] += np.uint64(draws) * _GOLDEN_GAMMA


@kernel
def uniform(state, world):
    """The next float64 in [0, 1) of the stream `state[world]` (uint64 `[num_worlds]`), which advances by one draw."""
    value = uniform_at(state[world], 1)
    skip_ahead(state, world, 1)
    return value


@kernel
def fill_uniform(state, world, out):
    """Writes the next draws of the stream `state[world]` to `out` `[count]`: float64 in [0, 1)."""
    for i in range(out.shape[0]):
        out[i] = uniform(state, world)


def world_streams(seed: int, num_worlds: int) -> NDArray[np.uint64]:
    """Independent initial states `[num_worlds]` uint64 for the worlds of one batch."""
    return np.random.SeedSequence(seed).generate_state(num_worlds, dtype=np.uint64).astype(np.uint64)
