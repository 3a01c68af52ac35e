"""The sum tree against numpy's cumulative sums."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from actors.replay.sum_tree import SumTree

ALMOST_1 = np.nextafter(1.0, 0.0)


def tree_of(values):
    tree = SumTree(len(values))
    tree.load(np.asarray(values, float))
    return tree


def masses(uniform, strata, total):
    """Position of each draw in the total: batches of `strata` draws, one draw in each of as many equal ranges."""
    found = []
    for start in range(0, len(uniform), strata):
        batch = uniform[start : start + strata]
        found += [(i + u) / len(batch) * total for i, u in enumerate(batch)]
    return np.array(found)


@given(
    values=st.lists(st.integers(0, 6), min_size=1, max_size=40).filter(any),
    count=st.integers(1, 50),
    strata=st.integers(1, 20),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=200, deadline=None)
def test_samples_equal_a_search_in_the_cumulative_sums(values, count, strata, seed):
    """Integers have exact sums, so the slots must be identical."""
    uniform = np.random.default_rng(seed).random(count)
    slots, found = tree_of(values).stratified_sample(uniform, strata)
    expected = np.searchsorted(np.cumsum(values), masses(uniform, strata, sum(values)), side="right")
    np.testing.assert_array_equal(slots, expected)
    np.testing.assert_array_equal(found, np.asarray(values, float)[expected])


@given(
    values=st.lists(st.sampled_from([0.0, 1e-12, 0.1, 1 / 3, 7.7, 1e9]), min_size=1, max_size=70).filter(any),
    uniform=st.lists(st.sampled_from([0.0, 5e-324, 0.1, 0.5, ALMOST_1]), min_size=1, max_size=20),
)
@settings(max_examples=200, deadline=None)
def test_rounding_errors_reach_no_zero_and_stay_small(values, uniform):
    slots, found = tree_of(values).stratified_sample(np.array(uniform), len(uniform))
    assert (found > 0).all()
    ends = np.cumsum(values)
    wanted, slack = masses(uniform, len(uniform), ends[-1]), 1e-13 * ends[-1]
    assert ((ends - values)[slots] - slack <= wanted).all() and (wanted <= ends[slots] + slack).all()


@st.composite
def changes(draw):
    """A capacity and changes of values."""
    capacity = draw(st.integers(1, 33))
    value = st.floats(0, 1e6, allow_nan=False)
    slot = st.integers(0, capacity - 1)
    fills = st.tuples(slot, st.integers(0, capacity), value)
    sets = st.lists(st.tuples(slot, value), max_size=12)
    return capacity, draw(st.lists(fills | sets, max_size=8))


@given(changes())
@settings(max_examples=150, deadline=None)
def test_the_leaves_alone_determine_the_tree(case):
    capacity, steps = case
    tree, expected = SumTree(capacity), np.zeros(capacity)
    for step in steps:
        if isinstance(step, tuple):
            start, count, value = step
            count = min(count, capacity - start)
            tree.fill(start, count, value)
            expected[start : start + count] = value
        else:
            tree.set(np.array([slot for slot, _ in step], np.int64), np.array([value for _, value in step]))
            for slot, value in step:
                expected[slot] = value
    np.testing.assert_array_equal(tree.values, expected)
    np.testing.assert_array_equal(tree._tree, tree_of(expected)._tree)
    assert tree.total == pytest.approx(math.fsum(expected), rel=1e-14)


def test_sums_do_not_drift():
    rng = np.random.default_rng(0)
    tree = SumTree(1000)
    tree.fill(0, 1000, 1e8)
    for _ in range(300):
        slots = rng.integers(1000, size=400)
        tree.set(slots, rng.choice([1e-6, 1e8], size=400))
    tree.fill(0, 1000, 1e-6)
    assert tree.total == pytest.approx(1e-3, rel=1e-13)


def test_loading_fewer_values_sets_the_others_to_zero():
    tree = tree_of([1.0, 2.0, 3.0])
    tree.load(np.array([5.0]))
    assert tree.values.tolist() == [5.0, 0.0, 0.0] and tree.total == 5.0


@pytest.mark.parametrize("strata", [1, 64, 100_000])
def test_slots_are_drawn_in_proportion_to_their_values(strata):
    values = np.random.default_rng(1).choice([0.0, 0.1, 1.0, 3.0], size=100)
    slots, _ = tree_of(values).stratified_sample(np.random.default_rng(2).random(100_000), strata)
    counts, positive = np.bincount(slots, minlength=100), values > 0
    assert not counts[~positive].any()
    expected = 100_000 * values / values.sum()
    if strata == 1:
        assert stats.chisquare(counts[positive], expected[positive]).pvalue > 1e-4
    assert (np.abs(counts - expected) <= 5 * np.sqrt(expected) + 1).all()


def test_a_batch_takes_one_draw_from_each_stratum():
    slots, _ = tree_of(np.full(16, 0.25)).stratified_sample(np.random.default_rng(3).random(16 * 5), 16)
    np.testing.assert_array_equal(slots.reshape(5, 16), np.tile(np.arange(16), (5, 1)))
