"""One random stream per world, whose whole state is a uint64 that a checkpoint can hold.

SplitMix64 (Steele, Lea, Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014). The state is a
counter, so any later draw can be computed without those before it. The draws of a world do not depend on the batch
that the world is in.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sim_core.jit import inlined, kernel
from sim_core.lanes import LANES, convert, lane_numbers, load_some, select, sqrt, store_some, view_bits

_GOLDEN_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_SHIFT_30, _SHIFT_27, _SHIFT_31, _SHIFT_11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_TO_UNIT = 1.0 / 9007199254740992.0
_SHIFT_32, _LOW_32 = np.uint64(32), np.uint64(0xFFFFFFFF)
_ZERO, _ONE, _TWO, _HALF, _QUARTER, _TO_UNIT_32 = map(np.float32, (0.0, 1.0, 2.0, 0.5, 0.25, 2.0**-32))
_LN_2, _THIRD, _FIFTH, _SEVENTH = map(np.float32, (math.log(2.0), 1 / 3, 1 / 5, 1 / 7))
_SQRT_HALF_BITS, _MANTISSA_BITS, _EXPONENT_ONE = np.int32(0x3F3504F3), np.int32(23), np.int32(2**23)
_SINE = [(-1.0) ** k * (2.0 * math.pi) ** (2 * k + 1) / math.factorial(2 * k + 1) for k in range(6)]
_S0, _S1, _S2, _S3, _S4, _S5 = map(np.float32, _SINE)


@kernel
def bits_at(state, draw):
    """Draw number `draw` (from 1) after the stream's uint64 `state`, as a uint64. The state stays."""
    z = state + np.uint64(draw) * _GOLDEN_GAMMA
    z = (z ^ (z >> _SHIFT_30)) * _MIX_1
    z = (z ^ (z >> _SHIFT_27)) * _MIX_2
    return z ^ (z >> _SHIFT_31)


@kernel
def uniform_at(state, draw):
    """Draw number `draw` (from 1) after the stream's uint64 `state`: a float64 in [0, 1). The state stays."""
    return np.float64(bits_at(state, draw) >> _SHIFT_11) * _TO_UNIT


@inlined
def lanes_at(state, draw, stride):
    """Draws `draw`, `draw` + `stride` and so on, one a lane, as `bits_at` gives them: a vector of uint64."""
    first, step = state + np.uint64(draw) * _GOLDEN_GAMMA, np.uint64(stride) * _GOLDEN_GAMMA
    z = convert(lane_numbers(), np.uint64) * step + first
    z = (z ^ (z >> _SHIFT_30)) * _MIX_1
    z = (z ^ (z >> _SHIFT_27)) * _MIX_2
    return z ^ (z >> _SHIFT_31)


@inlined
def uniforms_at(state, draw, stride):
    """The draws of `lanes_at` as `uniform_at` gives them: a vector of float64 in [0, 1)."""
    return convert(lanes_at(state, draw, stride) >> _SHIFT_11, np.float64) * _TO_UNIT


@inlined
def _log(u):
    """Ln u of a float32 in (0, 1]: u = m 2^e with m in [sqrt(1/2), sqrt(2)), and ln m = 2 artanh((m - 1) / (m + 1))."""
    bits = view_bits(u, np.int32)
    e = (bits - _SQRT_HALF_BITS) >> _MANTISSA_BITS
    m = view_bits(bits - e * _EXPONENT_ONE, np.float32)
    s = (m - _ONE) / (m + _ONE)
    z = s * s
    return convert(e, np.float32) * _LN_2 + _TWO * s * (_ONE + z * (_THIRD + z * (_FIFTH + z * _SEVENTH)))


@inlined
def _sine(turns):
    """The sine of a float32 number of turns in [-1/4, 1/4], by its series."""
    z = turns * turns
    return turns * (_S0 + z * (_S1 + z * (_S2 + z * (_S3 + z * (_S4 + z * _S5)))))


@inlined
def _normal_pairs(bits, scale):
    """Box and Muller's two normal numbers (x, y) of the draws `bits` (see `add_normal`)."""
    u = (convert(convert(bits >> _SHIFT_32, np.uint32), np.float32) + _HALF) * _TO_UNIT_32
    turns = convert(view_bits(convert(bits, np.uint32), np.int32), np.float32) * _TO_UNIT_32
    radius = scale * sqrt(-_TWO * _log(u))
    ahead = _QUARTER - abs(turns)
    aside = _QUARTER - abs(ahead)
    return radius * _sine(ahead), radius * _sine(select(turns < _ZERO, -aside, aside))


@inlined
def add_normal(state, draw, stride, scale, out_x, out_y):
    """Adds normal noise of standard deviation `scale` to points (out_x, out_y) `[count]`, all of them float32.

    Point i takes draw `draw` + `stride` i after `state`: its high 32 bits, as a float32 in (0, 1], give the radius, its
    low ones, as a signed number of turns, the direction (Box and Muller 1958). So the largest radius is 6.7. Logarithm
    and sine are series of plain operations: vectors compute them without a branch or call, and every machine the same
    numbers.
    """
    for i in range(0, out_x.shape[0], LANES):
        count = out_x.shape[0] - i
        x, y = _normal_pairs(lanes_at(state, draw + stride * i, stride), scale)
        store_some(out_x, i, count, load_some(out_x, i, count) + x)
        store_some(out_y, i, count, load_some(out_y, i, count) + y)


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
