"""Kernels cannot allocate memory, and divide as IEEE 754 says."""

from typing import Any, NamedTuple

import numpy as np
import pytest
from numba.core.errors import NumbaError

from sim_core.jit import StateKernel, kernel


def _makes_an_array(x):
    return np.zeros(3)[0] + x


def _makes_an_empty_array(x):
    made = np.empty(3)
    made[0] = x
    return made[0]


def _makes_a_list(x):
    return [x, x][0]


def _copies(x):
    return np.full(3, x).copy()


def _adds_arrays(x):
    return (x + x)[0]


@pytest.mark.parametrize(
    "function, argument",
    [
        (_makes_an_array, 1.0),
        (_makes_an_empty_array, 1.0),
        (_makes_a_list, 1.0),
        (_copies, 1.0),
        (_adds_arrays, np.ones(3)),
    ],
)
def test_a_kernel_that_allocates_is_refused(function, argument):
    with pytest.raises(NumbaError):
        kernel(function)(argument)


def test_division_by_zero_follows_ieee_754():
    divide = kernel(lambda x, y: x / y)
    assert divide(1.0, 0.0) == np.inf and np.isnan(divide(0.0, 0.0))


class _Pair(NamedTuple):
    """Two arrays."""

    first: Any
    second: Any


@kernel
def _add_pair(pair, out):
    for i in range(out.shape[0]):
        out[i] = pair.first[i] + pair.second[i]


def test_a_kernel_of_states_takes_states_of_other_types_in_turn():
    call, out = StateKernel(_add_pair), np.zeros(3)
    real, whole = _Pair(np.full(3, 0.5), np.full(3, 1.25)), _Pair(np.arange(3), np.arange(3))
    for _ in range(2):
        call(real, out)
        np.testing.assert_array_equal(out, 1.75)
        call(real, out)
        np.testing.assert_array_equal(out, 1.75)
        call(whole, out)
        np.testing.assert_array_equal(out, [0, 2, 4])
    real.first[:] = 1.0  # the arrays may change, as long as the tuple is the same
    call(real, out)
    np.testing.assert_array_equal(out, 2.25)
