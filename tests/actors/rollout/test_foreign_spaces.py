"""Flat observations, against Gymnasium's own flattening."""

import numpy as np
import pytest
from gymnasium import spaces

from actors.rollout.foreign_spaces import Unfit, flat_space, make_encoder

BOX = spaces.Box(-1, 1, (2,), np.float32)
FLATTENED = {
    "discrete": (spaces.Discrete(5, start=-2), np.uint8),
    "binary": (spaces.MultiBinary((2, 3)), np.uint8),
    "multi": (spaces.MultiDiscrete([2, 4]), np.uint8),
    "dict": (spaces.Dict({"a": BOX, "b": spaces.Discrete(3)}), np.float32),
    "bytes": (spaces.Dict({"a": spaces.Box(0, 255, (2, 2), np.uint8), "b": spaces.Discrete(3)}), np.uint8),
    "tuple": (spaces.Tuple((BOX, spaces.Dict({"c": spaces.Box(-1, 1, (), np.float64)}))), np.float32),
    "unbounded": (spaces.Tuple((spaces.Box(-np.inf, np.inf, (2,), np.float64), spaces.Discrete(2))), np.float32),
    "integers": (spaces.Tuple((spaces.Box(-5, 5, (2,), np.int64),)), np.float32),
}


@pytest.mark.parametrize("name", FLATTENED)
def test_a_space_is_flattened_as_gymnasium_does(name):
    space, dtype = FLATTENED[name]
    flat = flat_space(space)
    encode = make_encoder(space, flat)
    assert flat.dtype == dtype and flat.shape == spaces.utils.flatten_space(space).shape
    space.seed(3)
    for _ in range(20):
        value = space.sample()
        encoded = encode(value)
        np.testing.assert_array_equal(encoded, spaces.utils.flatten(space, value).astype(dtype))
        assert encoded.dtype == dtype and flat.contains(encoded)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.uint8, np.int64])
def test_a_box_stays_as_it_is(dtype):
    space = spaces.Box(0, 1, (2, 3), dtype)
    assert flat_space(space) is space
    value = space.sample()
    assert make_encoder(space, space)(value) is value


@pytest.mark.parametrize(
    ("space", "words"),
    [
        (None, "no gymnasium.Space"),
        ("Box", "no gymnasium.Space"),
        (spaces.Box(0, 1, ()), "one number has the shape"),
        (spaces.Box(0, 1, (0, 3)), "without a dimension"),
        (spaces.Box(0, 1, (2,), np.longdouble), "none of integers and floats up to 64 bits"),
        (spaces.Discrete(10**9), "1,000,000,000 elements"),
        (spaces.Sequence(BOX), "cannot be flattened"),
        (spaces.Graph(BOX, None), "cannot be flattened"),
        (spaces.Dict({"a": spaces.Sequence(BOX)}), "cannot be flattened"),
        (spaces.Dict({}), "without an element"),
    ],
)
def test_other_spaces_are_refused(space, words):
    with pytest.raises(Unfit, match=words):
        flat_space(space)


PARTS = spaces.Dict({"a": BOX, "b": spaces.Tuple((spaces.Discrete(3, start=1),))})


@pytest.mark.parametrize(
    ("space", "value", "words"),
    [
        (BOX, np.zeros(3, np.float32), r"shape \(3,\)"),
        (BOX, None, r"shape \(\)"),
        (BOX, ["a", "b"], "dtype <U1"),
        (BOX, np.zeros(2, complex), "dtype complex128"),
        (spaces.Box(0, 255, (2,), np.uint8), np.zeros(2), "dtype float64"),
        (PARTS, {"a": np.zeros(2, np.float32)}, "has not the keys a, b"),
        (PARTS, [1], "has not the keys a, b"),
        (PARTS, {"a": np.zeros(1, np.float32), "b": (1,)}, r"shape \(1,\)"),
        (PARTS, {"a": np.zeros(2, np.float32), "b": 1}, "has not 1 parts"),
        (PARTS, {"a": np.zeros(2, np.float32), "b": (0,)}, "none of Discrete"),
        (spaces.Discrete(3), -1, "none of Discrete"),
        (spaces.Discrete(3), 1.0, "none of Discrete"),
        (spaces.MultiDiscrete([2, 2]), [0, 2], "none of MultiDiscrete"),
    ],
)
def test_an_observation_that_is_none_of_its_space_is_refused(space, value, words):
    with pytest.raises(Unfit, match=words):
        make_encoder(space, flat_space(space))(value)


@pytest.mark.parametrize("value", [[0.5, 2.0], (1, 0), np.array([7, -7]), np.array([0.5, 0.1])])
def test_numbers_of_another_type_or_beyond_the_limits_are_taken(value):
    array = make_encoder(BOX, BOX)(value)
    np.testing.assert_array_equal(array, np.asarray(value, np.float32))
    assert array.dtype == np.float32
