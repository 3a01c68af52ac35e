"""Observations of foreign environments as arrays: a Box stays as it is, other spaces are flattened by Gymnasium."""

from __future__ import annotations

import functools
import reprlib
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

MAX_FLAT_SIZE = 1_000_000
"""Most elements of a flattened observation; a Discrete of as many values needs as many in one-hot form."""
Encoder = Callable[[Any], NDArray[Any]]
"""Makes an array of an observation; raises Unfit if the observation is none of its space."""


class Unfit(Exception):
    """What an environment gave does not fit; the message goes on after "the environment gave"."""


def shown(value: Any) -> str:
    """A value in a few characters, on one line."""
    return " ".join(reprlib.repr(value).split())


def flat_space(space: Any) -> spaces.Box:
    """The Box of an observation: `space` itself, or where it is another one, the Box that it is flattened to.

    A Discrete is one-hot, a MultiDiscrete several of these; Dict and Tuple are their parts in order.

    Raises:
      Unfit: it is no space of Gymnasium, has no elements, or cannot be flattened to a Box.
    """
    if not isinstance(space, gym.Space):
        raise Unfit(f"the observation_space {shown(space)}, which is no gymnasium.Space")
    if isinstance(space, spaces.Box):
        if space.shape == () or 0 in space.shape:
            raise Unfit(f"the observation_space {space} without a dimension; one number has the shape (1,)")
        if space.dtype.kind not in "biuf" or space.dtype.itemsize > 8:
            raise Unfit(f"the observation_space {space}, whose numbers are none of integers and floats up to 64 bits")
        return space
    size = _flat_size(space)
    if size > MAX_FLAT_SIZE:
        raise Unfit(f"an observation_space of {size:,} elements in one-hot form, where {MAX_FLAT_SIZE:,} are the most")
    flat = spaces.utils.flatten_space(space)
    assert isinstance(flat, spaces.Box)  # a space with a flat size has one
    are_bytes = flat.dtype.kind in "bui" and flat.low.min() >= 0 and flat.high.max() <= 255
    dtype = np.uint8 if are_bytes else np.float32
    limits = np.clip([flat.low, flat.high], np.finfo(np.float32).min, np.finfo(np.float32).max).astype(dtype)
    return spaces.Box(*limits, dtype=dtype)


def _flat_size(space: gym.Space[Any]) -> int:
    try:
        size = spaces.utils.flatdim(space)
    except (ValueError, NotImplementedError) as error:
        raise Unfit(f"the observation_space {shown(space)}, which cannot be flattened to a Box ({error})") from error
    if size == 0:
        raise Unfit(f"the observation_space {shown(space)} without an element")
    return int(size)


def make_encoder(space: gym.Space[Any], flat: spaces.Box) -> Encoder:
    """How observations of `space` become arrays of the shape and dtype of `flat`, its `flat_space`."""
    if isinstance(space, spaces.Box):
        return functools.partial(_array, space)

    def encode(value: Any) -> NDArray[Any]:
        _check(space, value)
        with np.errstate(over="ignore"):  # as in `_as_dtype`
            return _as_dtype(np.asarray(spaces.utils.flatten(space, value)), flat.dtype)

    return encode


def _check(space: gym.Space[Any], value: Any) -> None:
    """Raises Unfit unless `value` has the structure, the shapes and the types of `space`.

    Numbers beyond a Box's limits pass: many environments are not exact about these.
    """
    if isinstance(space, spaces.Box):
        _array(space, value)
    elif isinstance(space, spaces.Dict):
        if not isinstance(value, Mapping) or set(value) != set(space.spaces):
            raise Unfit(f"the observation {shown(value)}, which has not the keys {', '.join(map(str, space.spaces))}")
        for key, part in space.spaces.items():
            _check(part, value[key])
    elif isinstance(space, spaces.Tuple):
        if not isinstance(value, tuple | list) or len(value) != len(space.spaces):
            raise Unfit(f"the observation {shown(value)}, which has not {len(space.spaces)} parts")
        for part, element in zip(space.spaces, value, strict=True):
            _check(part, element)
    elif not space.contains(value):
        raise Unfit(f"the observation {shown(value)}, which is none of {space}")


def _array(space: spaces.Box, value: Any) -> NDArray[Any]:
    """`value` as an array of the Box's shape, of a dtype that becomes the Box's without losing more than precision."""
    if type(value) is np.ndarray and value.shape == space.shape and value.dtype == space.dtype:
        return value
    array = np.asarray(value)
    if array.shape != space.shape:
        raise Unfit(f"an observation of shape {array.shape}, where observation_space has {space.shape}")
    if not np.can_cast(array.dtype, space.dtype, "same_kind"):
        raise Unfit(f"an observation of dtype {array.dtype}, where observation_space has {space.dtype}")
    return _as_dtype(array, space.dtype)


def _as_dtype(array: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """`array` in another dtype; a number that it does not hold becomes infinite, which is found out later."""
    with np.errstate(over="ignore"):
        return array.astype(dtype, copy=False)
