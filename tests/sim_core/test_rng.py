"""The random streams against published outputs of SplitMix64 and scipy's statistical tests."""

import numpy as np
from scipy import stats

from sim_core.rng import uniform, world_streams


def draws(state, count):
    """`[count]` draws of world 0."""
    return np.array([uniform(state, 0) for _ in range(count)])


def test_matches_the_reference_outputs():
    # SplitMix64 of seed 1234567: the test vector that implementations commonly use.
    expected = [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431]
    state = np.array([1234567], np.uint64)
    assert [uniform(state, 0) for _ in expected] == [(value >> 11) / 2**53 for value in expected]


def test_the_largest_draw_stays_below_one():
    assert (np.float64((2**64 - 1) >> 11)) / 2**53 < 1
    state = world_streams(3, 1)
    values = draws(state, 20_000)
    assert values.min() >= 0 and values.max() < 1
    assert stats.kstest(values, "uniform").pvalue > 1e-3


def test_a_draw_advances_only_its_own_stream():
    state = world_streams(0, 3)
    before = state.copy()
    uniform(state, 1)
    assert list(state != before) == [False, True, False]


def test_streams_of_adjacent_seeds_are_uncorrelated():
    first = np.array([uniform(world_streams(seed, 1), 0) for seed in range(2000)])
    assert stats.kstest(first, "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(first[:-1], first[1:])[0, 1]) < 0.07
    assert len(np.unique(world_streams(5, 1000))) == 1000
