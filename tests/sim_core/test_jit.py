"""Kernels cannot allocate memory, and divide as IEEE 754 says."""

import numpy as np
import pytest
from numba.core.errors import NumbaError

from sim_core.jit import kernel


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
