"""Every operation on vectors against numpy, bit for bit, with ordinary and special numbers."""

import itertools

import numpy as np
import pytest
from numba.core.errors import TypingError

from sim_core.jit import kernel
from sim_core.lanes import (
    LANES,
    WIDE,
    any_lane,
    convert,
    count_lanes,
    extract_lane,
    gather,
    gather_4,
    lane_numbers,
    load,
    load_some,
    load_wide,
    maximum,
    minimum,
    scatter,
    select,
    splat,
    sqrt,
    store,
    store_numbers,
    store_some,
    store_wide,
    view_bits,
)

REALS = (np.float32, np.float64)
TYPES = (*REALS, np.int32)
MASKS = 256  # all masks of eight lanes


def special_numbers(dtype):
    """Ordinary, extreme and special numbers of a type."""
    drawn = np.random.default_rng(0).normal(0, 3, 9)
    if dtype == np.int32:
        return np.array([0, 1, -1, 2, 7, -13, 2**31 - 1, -(2**31), *(1000 * drawn)]).astype(dtype)
    limits = np.finfo(dtype)
    special = [0.0, -0.0, np.inf, -np.inf, np.nan, 1.0, -1.0, limits.max, -limits.max, limits.tiny, limits.eps]
    return np.array([*special, limits.smallest_subnormal, -limits.smallest_subnormal, 3.0, -2.5, *drawn], dtype)


def pairs(dtype):
    """All pairs of special numbers as two arrays of equal size; some pairs repeat, so that all vectors are full."""
    found = np.array(list(itertools.product(special_numbers(dtype), repeat=2)), dtype).T
    return np.ascontiguousarray(np.resize(found, (2, -(-found.shape[1] // LANES) * LANES)))


def assert_same_bits(found, expected, message=""):
    """Equal in every bit, except that all NaNs count as equal."""
    found, expected = np.asarray(found), np.asarray(expected)
    assert (found.dtype, found.shape) == (expected.dtype, expected.shape), message
    if found.dtype.kind == "f":
        assert np.array_equal(np.signbit(found) & ~np.isnan(found), np.signbit(expected) & ~np.isnan(expected)), message
    np.testing.assert_array_equal(found, expected, err_msg=message)


def assert_all_same(found, expected):
    """The rows of a kernel's results are numpy's results, given by name."""
    for row, (name, values) in zip(found, expected.items(), strict=True):
        assert_same_bits(row, values, name)


@kernel
def _arithmetic(a, b, scalar, out, masks):
    vectors = a.shape[0] // LANES
    for i in range(vectors):
        x, y = load(a, i), load(b, i)
        results = (
            x + y, x - y, x * y, x * y + x, x + scalar, scalar + x, x - scalar, scalar - x, x * scalar, scalar * x,
            x + 2, 2 - x, select(x < y, x, y), select(x < y, scalar, y), select(x < y, x, scalar), splat(scalar),
        )  # fmt: skip
        for k in range(len(results)):
            store(out, k * vectors + i, results[k])
        compared = (
            x < y, x <= y, x > y, x >= y, x == y, x != y,
            x < scalar, scalar < x, x >= scalar, scalar >= x, x == scalar, scalar != x,
        )  # fmt: skip
        for k in range(len(compared)):
            store(masks, k * vectors + i, select(compared[k], splat(1), splat(0)))


def arithmetic_of_numpy(x, y, s):
    """(results, comparisons) by name, in the order of `_arithmetic`."""
    two, every = x.dtype.type(2), np.full_like(x, s)
    differ = (x < y) | (x > y)  # ordered: false with NaN
    results = {
        "x + y": x + y, "x - y": x - y, "x * y": x * y, "x * y + x": x * y + x, "x + s": x + s, "s + x": s + x,
        "x - s": x - s, "s - x": s - x, "x * s": x * s, "s * x": s * x, "x + 2": x + two, "2 - x": two - x,
        "select": np.where(x < y, x, y), "select s else y": np.where(x < y, every, y),
        "select x else s": np.where(x < y, x, every), "splat": every,
    }  # fmt: skip
    compared = {
        "x < y": x < y, "x <= y": x <= y, "x > y": x > y, "x >= y": x >= y, "x == y": x == y, "x != y": differ,
        "x < s": x < s, "s < x": s < x, "x >= s": x >= s, "s >= x": s >= x, "x == s": x == s,
        "s != x": (x < s) | (x > s),
    }  # fmt: skip
    return results, compared


@pytest.mark.parametrize("dtype", TYPES)
def test_arithmetic_comparison_and_select(dtype):
    a, b = pairs(dtype)
    for scalar in special_numbers(dtype):
        with np.errstate(all="ignore"):
            results, compared = arithmetic_of_numpy(a, b, scalar)
        out, masks = np.full((len(results), len(a)), 77, dtype), np.full((len(compared), len(a)), 77, np.int32)
        _arithmetic(a, b, scalar, out, masks)
        assert_all_same(out, results)
        assert_all_same(masks != 0, compared)


@kernel
def _float_arithmetic(a, b, scalar, out):
    vectors = a.shape[0] // LANES
    for i in range(vectors):
        x, y = load(a, i), load(b, i)
        results = (
            x / y, x / scalar, scalar / x, sqrt(x), -x, abs(x), minimum(x, y), maximum(x, y), x / 3, 0.1 * x,
        )  # fmt: skip
        for k in range(len(results)):
            store(out, k * vectors + i, results[k])


@pytest.mark.parametrize("dtype", REALS)
def test_arithmetic_of_floats(dtype):
    a, b = pairs(dtype)
    for scalar in special_numbers(dtype):
        with np.errstate(all="ignore"):
            expected = {
                "x / y": a / b, "x / s": a / scalar, "s / x": scalar / a, "sqrt": np.sqrt(a), "-x": -a,
                "abs": np.abs(a),
                "minimum": np.where(a < b, a, b), "maximum": np.where(a > b, a, b), "x / 3": a / dtype(3),
                "0.1 * x": dtype(0.1) * a,
            }  # fmt: skip
        out = np.full((len(expected), len(a)), 77, dtype)
        _float_arithmetic(a, b, scalar, out)
        assert_all_same(out, expected)


@kernel
def _bitwise(a, b, scalar, out):
    vectors = a.shape[0] // LANES
    for i in range(vectors):
        x, y = load(a, i), load(b, i)
        results = (x & y, x | y, ~x, x & scalar, scalar & x, x | scalar, scalar | x, x & 6, x | 1, splat(-7))
        for k in range(len(results)):
            store(out, k * vectors + i, results[k])


def test_bitwise_operations_of_integers():
    a, b = pairs(np.int32)
    for s in special_numbers(np.int32):
        expected = {
            "x & y": a & b, "x | y": a | b, "~x": ~a, "x & s": a & s, "s & x": a & s, "x | s": a | s, "s | x": a | s,
            "x & 6": a & 6, "x | 1": a | 1, "splat": np.full_like(a, -7),
        }  # fmt: skip
        out = np.full((len(expected), len(a)), 77, np.int32)
        _bitwise(a, b, s, out)
        assert_all_same(out, expected)


@kernel
def _masks(a, b, flag, out, some):
    one, zero = splat(1), splat(0)
    vectors = a.shape[0] // LANES
    for i in range(vectors):
        p, q = load(a, i) != 0, load(b, i) != 0
        results = (p & q, p | q, ~p, p == q, p != q, p & ~q | (q & ~p), splat(True), splat(False), splat(flag))
        for k in range(len(results)):
            store(out, k * vectors + i, select(results[k], one, zero))
        some[i] = any_lane(p)


def test_masks():
    lanes = np.arange(MASKS)[:, None] >> np.arange(LANES) & 1
    a = np.resize(lanes, (3, MASKS, LANES)).astype(np.int32)
    b = np.stack([lanes, lanes[::-1], np.roll(lanes, 85, axis=0)]).astype(np.int32)
    p, q, no = a != 0, b != 0, np.zeros(a.shape, bool)
    for flag in (True, False):
        out, some = np.full((9, *a.shape), 77, np.int32), np.full(3 * MASKS, True)
        _masks(a.ravel(), b.ravel(), flag, out, some)
        expected = (p & q, p | q, ~p, p == q, p != q, p ^ q, ~no, no, no | flag)
        np.testing.assert_array_equal(out, np.array(expected).astype(np.int32))
        np.testing.assert_array_equal(some, np.tile(np.arange(MASKS) > 0, 3))  # only mask 0 is empty


@kernel
def _memory(source, table, indices, rows, out, columns, scattered, lanes):
    last = indices.shape[0] // LANES - 1
    for i in range(last, -1, -1):
        index = load(indices, i)
        found = gather(source, index)
        store(out, i, found)
        scatter(scattered, index, load(source, i))
        four = gather_4(table, load(rows, i))
        for k in range(4):
            store(columns, 4 * i + k, four[k])
        for k in range(LANES):
            lanes[i, k] = extract_lane(found, k)
    return extract_lane(load(source, 0), 2)


@pytest.mark.parametrize("dtype", TYPES)
def test_reading_and_writing_memory(dtype):
    rng = np.random.default_rng(1)
    vectors, size = 20, 20 * LANES
    source = rng.integers(-1000, 1000, (4, size // 4)).astype(dtype)  # indexed flat
    table = rng.integers(-1000, 1000, (5, 6, 4)).astype(dtype)
    indices = rng.integers(0, size, (vectors, LANES)).astype(np.int32)
    indices[3], indices[4], indices[5] = 7, np.arange(LANES)[::-1], [0, size - 1] * 4  # repeated, reversed, at the ends
    rows = rng.integers(0, 30, (vectors, LANES)).astype(np.int32)
    rows[1], rows[2] = 29, [0, 29] * 4
    out, lanes = np.zeros((2, vectors, LANES), dtype)
    columns, scattered = np.zeros((vectors, 4, LANES), dtype), np.full(size, 77, dtype)
    third = _memory(source, table, indices.ravel(), rows.ravel(), out, columns, scattered, lanes)
    flat = source.ravel()
    assert_same_bits(out, flat[indices])
    assert_same_bits(lanes, flat[indices])
    assert third == flat[2]
    assert_same_bits(columns, table.reshape(30, 4)[rows].transpose(0, 2, 1))
    expected = np.full(size, 77, dtype)
    for i in range(vectors - 1, -1, -1):
        for k in range(LANES):  # where an index is repeated, the last lane's value stays
            expected[indices[i, k]] = flat[LANES * i + k]
    assert_same_bits(scattered, expected)


@kernel
def _unsigned(a, b, out, masks):
    vectors = a.shape[0] // LANES
    for i in range(vectors):
        x, y = load(a, i), load(b, i)
        results = (x ^ y, x ^ a[0], x >> a[8], x * y, x + a[1])
        for k in range(len(results)):
            store(out, k * vectors + i, results[k])
        store(masks, i, select(x < y, splat(1), splat(0)))


@pytest.mark.parametrize("dtype", [np.uint64, np.uint8])
def test_whole_numbers_without_a_sign(dtype):
    most = int(np.iinfo(dtype).max)
    numbers = np.array([1, most, 0, most // 2, most // 2 + 1, 77, 3, most - 5, 6, *range(11, 18)], dtype)
    a, b = np.ascontiguousarray(np.array(list(itertools.product(numbers, repeat=2)), dtype).T)
    out, masks = np.zeros((5, len(a)), dtype), np.zeros(len(a), np.int32)
    _unsigned(a, b, out, masks)
    with np.errstate(over="ignore"):
        expected = {"x ^ y": a ^ b, "x ^ s": a ^ a[0], "x >> s": a >> a[8], "x * y": a * b, "x + s": a + a[1]}
    assert_all_same(out, expected)
    np.testing.assert_array_equal(masks != 0, a < b)


@kernel
def _shifts(a, out):
    for i in range(a.shape[0] // LANES):
        store(out, i, load(a, i) >> np.int32(3))


def test_a_shift_keeps_the_sign():
    a, _ = pairs(np.int32)
    out = np.zeros_like(a)
    _shifts(a, out)
    np.testing.assert_array_equal(out, a >> 3)


@kernel
def _convert(source, out, dtype):
    for i in range(source.shape[0] // LANES):
        store(out, i, convert(load(source, i), dtype))


CONVERSIONS = [
    (np.int32, np.float32), (np.int32, np.float64), (np.int32, np.uint64), (np.uint64, np.float64),
    (np.uint64, np.uint32), (np.uint32, np.float32), (np.uint8, np.int32), (np.float32, np.float64),
    (np.float64, np.float32), (np.float32, np.float32),
]  # fmt: skip


@pytest.mark.parametrize("source, target", CONVERSIONS)
def test_conversions(source, target):
    if np.issubdtype(source, np.floating):
        numbers = np.resize(special_numbers(source), 32)
    else:
        limits = np.iinfo(source)
        ends = [int(limits.min), int(limits.max), int(limits.max) // 2 + 1, int(limits.max) // 3]
        numbers = np.array([*ends, *range(12)], np.dtype(source))
    out = np.zeros(len(numbers), target)
    _convert(numbers, out, target)
    with np.errstate(all="ignore"):
        assert_same_bits(out, numbers.astype(target))


@kernel
def _view(source, out, dtype):
    for i in range(source.shape[0] // LANES):
        store(out, i, view_bits(load(source, i), dtype))


@pytest.mark.parametrize("source, target", [(np.float32, np.int32), (np.int32, np.float32), (np.uint32, np.int32)])
def test_bits_are_read_as_another_type(source, target):
    numbers = np.arange(1, 33, dtype=source)
    out = np.zeros(32, target)
    _view(numbers, out, target)
    np.testing.assert_array_equal(out, numbers.view(target))


@kernel
def _copy_some(source, first, count, target, at, all_lanes):
    some = load_some(source, first, count)
    store(all_lanes, 0, some)
    store_some(target, at, count, some)


@pytest.mark.parametrize("dtype", [*TYPES, np.uint8, np.uint64])
@pytest.mark.parametrize("count", [0, 1, 2, 7, 8, 11])
def test_some_lanes_are_read_and_written_and_nothing_beyond(dtype, count):
    source, target = np.arange(1, 21, dtype=dtype), np.full(20, 77, dtype)
    lanes, most = np.full(LANES, 55, dtype), min(count, LANES)
    _copy_some(source, 5, count, target, 3, lanes)
    np.testing.assert_array_equal(lanes, [*source[5 : 5 + most], *[0] * (LANES - most)])
    np.testing.assert_array_equal(target[3 : 3 + most], source[5 : 5 + most])
    assert (np.delete(target, np.s_[3 : 3 + most]) == 77).all()


@kernel
def _wide(a, b, scalar, out):
    vectors = a.shape[0] // WIDE
    for i in range(vectors):
        x, y = load_wide(a, i), load_wide(b, i)
        results = (x + y, x * y, scalar * x, x - scalar, select(x < y, x, y), select(x == scalar, scalar, y))
        for k in range(len(results)):
            store_wide(out, k * vectors + i, results[k])


@pytest.mark.parametrize("dtype", REALS)
def test_wide_vectors(dtype):
    a, b = np.resize(pairs(dtype), (2, 40 * WIDE))
    s = dtype(3)
    with np.errstate(all="ignore"):
        expected = {
            "x + y": a + b, "x * y": a * b, "s * x": s * a, "x - s": a - s, "select": np.where(a < b, a, b),
            "select s else y": np.where(a == s, s, b),
        }  # fmt: skip
    out = np.zeros((len(expected), len(a)), dtype)
    _wide(a, b, s, out)
    assert_all_same(out, expected)


@kernel
def _numbers(values, out, counts):
    at = 0
    for i in range(values.shape[0] // LANES):
        mask = load(values, i) != 0
        at += store_numbers(out, at, mask, i * LANES)
        counts[i] = count_lanes(mask)
    return at


@kernel
def _wide_numbers(values, out, counts):
    at = 0
    for i in range(values.shape[0] // WIDE):
        mask = load_wide(values, i) != 0
        at += store_numbers(out, at, mask, i * WIDE)
        counts[i] = count_lanes(mask)
    return at


@pytest.mark.parametrize(("numbers", "lanes"), [(_numbers, LANES), (_wide_numbers, WIDE)])
def test_numbers_of_lanes_are_written_one_after_the_other(numbers, lanes):
    values = (np.random.default_rng(4).random(30 * lanes) < 0.4).astype(np.int32)
    values[: 2 * lanes], values[2 * lanes : 3 * lanes] = 0, 1  # none, then all
    out, counts = np.full(31 * lanes, 77, np.int32), np.zeros(30, np.int64)
    count = numbers(values, out, counts)
    np.testing.assert_array_equal(out[:count], np.flatnonzero(values))
    np.testing.assert_array_equal(counts, values.reshape(30, lanes).sum(axis=1))
    assert (out[count + lanes :] == 77).all()


@kernel
def _mixes_widths(a):
    store(a, 0, load(a, 0) + load_wide(a, 0))


def test_vectors_of_two_sizes_do_not_mix():
    with pytest.raises(TypingError, match=r"Lanes\(float32, 16\)"):
        _mixes_widths(np.zeros(WIDE, np.float32))


@kernel
def _number(out):
    store(out, 0, lane_numbers())


def test_lanes_have_numbers():
    out = np.zeros(LANES, np.int32)
    _number(out)
    np.testing.assert_array_equal(out, np.arange(LANES))


def _truncates(a):
    store(a, 0, convert(load(a, 0), np.int32))


def _views_another_size(a):
    store(a, 0, view_bits(load(a, 0), np.float64))


@pytest.mark.parametrize("function", [_truncates, _views_another_size])
def test_conversions_that_lose_numbers_are_refused(function):
    with pytest.raises(TypingError):
        kernel(function)(np.zeros(LANES, np.float32))


def _adds(a, b):
    store(a, 0, load(a, 0) + load(b, 0))


def _compares(a, b):
    return any_lane(load(a, 0) < load(b, 0))


def _adds_a_string(a, b):
    store(a, 0, load(a, 0) + "1")


def _adds_none(a, b):
    store(a, 0, None + load(a, 0))


def _adds_an_array(a, b):
    store(a, 0, load(a, 0) + a)


def _floor_divides(a, b):
    store(a, 0, load(a, 0) // 2)


def _takes_truth_value(a, b):
    return 1 if load(a, 0) < 0 else 2


@pytest.mark.parametrize("dtype", [np.float64, np.int32])
@pytest.mark.parametrize("function", [_adds, _compares])
def test_two_element_types_do_not_mix(function, dtype):
    with pytest.raises(TypingError, match=r"Lanes\(float32\)"):
        kernel(function)(np.zeros(LANES, np.float32), np.zeros(LANES, dtype))


@pytest.mark.parametrize("function", [_adds_a_string, _adds_none, _adds_an_array, _floor_divides, _takes_truth_value])
def test_unsupported_operations_are_refused(function):
    with pytest.raises(TypingError, match="Lanes"):
        kernel(function)(np.zeros(LANES, np.float32), np.zeros(LANES, np.float32))


def _adds_a_fraction(a):
    store(a, 0, load(a, 0) + 0.7)


def test_a_fraction_is_not_truncated_to_an_integer():
    with pytest.raises(TypingError):
        kernel(_adds_a_fraction)(np.zeros(LANES, np.int32))


def test_a_strided_array_is_refused():
    with pytest.raises(TypingError):
        kernel(_adds_a_fraction)(np.zeros(2 * LANES, np.float32)[::2])
