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

_GOLDEN_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_SHIFT_30, _SHIFT_27, _SHIFT_31, _SHIFT_11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_TO_UNIT = 1.0 / 9007199254740992.0
_SHIFT_32, _LOW_32, _TO_UNIT_32 = np.uint64(32), np.uint64(0xFFFFFFFF), 2.0**-32
_CENTRAL = 0.47575
_A = (
    -39.69683028665376,
    220.9460984245205,
    -275.9285104469687,
    138.357751867269,
    -30.66479806614716,
    2.506628277459239,
)
_B = (-54.47609879822406, 161.5858368580409, -155.6989798598866, 66.80131188771972, -13.28068155288572)
_C = (
    0.007784894002430293,
    0.3223964580411365,
    2.400758277161838,
    2.549732539343734,
    -4.374664141464968,
    -2.938163982698783,
)
_D = (0.007784695709041462, 0.3224671290700398, 2.445134137142996, 3.754408661907416)


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
def _central_quantile(q):
    """The standard normal quantile of 1/2 + q in the middle of the distribution, where |q| <= _CENTRAL."""
    r = q * q
    a = ((((_A[0] * r + _A[1]) * r + _A[2]) * r + _A[3]) * r + _A[4]) * r + _A[5]
    b = ((((_B[0] * r + _B[1]) * r + _B[2]) * r + _B[3]) * r + _B[4]) * r + 1.0
    return q * a / b


@inlined
def _tail_quantile(q):
    """The standard normal quantile of 1/2 + q in the tails."""
    r = math.sqrt(-2.0 * math.log(0.5 - abs(q)))
    c = ((((_C[0] * r + _C[1]) * r + _C[2]) * r + _C[3]) * r + _C[4]) * r + _C[5]
    d = (((_D[0] * r + _D[1]) * r + _D[2]) * r + _D[3]) * r + 1.0
    return math.copysign(c / d, q)


@inlined
def _halves(bits):
    """The two halves of a draw as numbers in (-1/2, 1/2)."""
    high, low = np.int64(bits >> _SHIFT_32), np.int64(bits & _LOW_32)
    return (high + 0.5) * _TO_UNIT_32 - 0.5, (low + 0.5) * _TO_UNIT_32 - 0.5


@inlined
def add_normal(state, draw, stride, scale, out_x, out_y):
    """Adds normal noise of standard deviation `scale` to points (out_x, out_y) `[count]`.

    Point i takes draw `draw` + `stride` i after `state`: x the quantile of its high 32 bits, y that of its low ones.
    Quantiles are P. J. Acklam's rational approximation, whose relative error is below 1.2e-9. The middle of the
    distribution is a loop without a branch, which compilers turn into vector code; the tails have a loop of their own.
    """
    for i in range(out_x.shape[0]):
        x, y = _halves(bits_at(state, draw + stride * i))
        noise_x, noise_y = scale * _central_quantile(x), scale * _central_quantile(y)
        out_x[i] += noise_x if abs(x) <= _CENTRAL else 0.0
        out_y[i] += noise_y if abs(y) <= _CENTRAL else 0.0
    for i in range(out_x.shape[0]):
        x, y = _halves(bits_at(state, draw + stride * i))
        if abs(x) > _CENTRAL:
            out_x[i] += scale * _tail_quantile(x)
        if abs(y) > _CENTRAL:
            out_y[i] += scale * _tail_quantile(y)


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
