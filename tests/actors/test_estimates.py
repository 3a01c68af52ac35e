"""Rates and means with their intervals, against closed forms and published numbers."""

import math

import numpy as np
import pytest
from scipy import stats

from actors.estimates import BINOMIAL, Dispersion, dispersion, mean, rate, rate_difference


def wilson(count, total):
    """E. B. Wilson (1927), written out."""
    z, share = stats.norm.ppf(0.975), count / total
    centre = (share + z * z / (2 * total)) / (1 + z * z / total)
    half = z / (1 + z * z / total) * math.sqrt(share * (1 - share) / total + z * z / (4 * total * total))
    return centre - half, centre + half


@pytest.mark.parametrize(("count", "total"), [(0, 1), (1, 1), (0, 20), (20, 20), (3, 7), (81, 263), (997, 1000)])
def test_rates_have_wilsons_interval(count, total):
    value, low, high = rate(count, total)
    assert value == count / total
    assert (low, high) == pytest.approx(wilson(count, total), abs=1e-12)
    assert 0 <= low <= value <= high <= 1


def test_rates_against_published_numbers():
    # R. G. Newcombe (1998), Table I, method 3 (score without continuity correction).
    for count, total, low, high in ((81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0, 0.1611)):
        assert rate(count, total)[1:] == pytest.approx((low, high), abs=5e-5)


def test_no_trials_are_refused():
    with pytest.raises(ValueError):
        rate(0, 0)


def test_means_have_students_interval():
    values = np.random.default_rng(0).normal(3, 2, 12)
    half = stats.t.interval(0.95, 11, loc=values.mean(), scale=values.std(ddof=1) / math.sqrt(12))
    assert mean(values).value == pytest.approx(values.mean())
    assert mean(values)[1:] == pytest.approx(half)
    # Five values by hand: mean 3, s = sqrt(2.5), t(0.975, 4) = 2.776.
    assert mean(np.arange(1, 6))[1:] == pytest.approx((3 - 2.7764 * 0.70711, 3 + 2.7764 * 0.70711), abs=1e-3)


@pytest.mark.parametrize("values", [[2.5], [2.5, 2.5, 2.5]])
def test_a_mean_without_spread_has_no_width(values):
    assert mean(np.array(values)) == (2.5, 2.5, 2.5)


def test_differences_against_published_numbers():
    # R. G. Newcombe (1998), "Interval estimation for the difference between independent proportions", Table II,
    # method 10.
    for first, second, low, high in (
        ((56, 70), (48, 80), 0.0524, 0.3339),
        ((9, 10), (3, 10), 0.1705, 0.8090),
        ((6, 7), (2, 7), 0.0582, 0.8062),
        ((5, 56), (0, 29), -0.0381, 0.1926),
        ((0, 10), (0, 20), -0.1611, 0.2775),
        ((10, 10), (0, 20), 0.6791, 1.0),
    ):
        found = rate_difference(first, second)
        assert found.value == pytest.approx(first[0] / first[1] - second[0] / second[1])
        assert found[1:] == pytest.approx((low, high), abs=6e-5)


def test_a_difference_turned_round_changes_its_sign():
    forth, back = rate_difference((7, 30), (50, 90)), rate_difference((50, 90), (7, 30))
    assert forth == pytest.approx((-back.value, -back.high, -back.low))


def test_counts_that_vary_more_are_worth_fewer_trials():
    assert rate(300, 1000, Dispersion(5.0)) == pytest.approx(rate(60, 200))
    wide = stats.t.ppf(0.975, 4) / stats.norm.ppf(0.975)
    few, many = (rate(50_000, 100_000, Dispersion(1.0, freedom)) for freedom in (4, math.inf))
    assert few.high - few.low == pytest.approx(wide * (many.high - many.low), rel=1e-3)


def test_dispersion_is_pearsons_chi_square_of_the_table():
    samples = [[(10, 100), (30, 100)], [(5, 50), (9, 80), (20, 90)]]
    tables = [np.array([(count, total - count) for count, total in pairs]) for pairs in samples]
    chi_square = sum(stats.chi2_contingency(table, correction=False).statistic for table in tables)
    assert dispersion(samples) == pytest.approx((chi_square / 3, 3))
    assert dispersion(samples, freedom=2) == pytest.approx((chi_square / 3, 2))


@pytest.mark.parametrize("samples", [[], [[(3, 10)]], [[(0, 10), (0, 20)], [(10, 10), (5, 5)]], [[(5, 10), (5, 10)]]])
def test_what_does_not_vary_is_binomial(samples):
    assert dispersion(samples) == BINOMIAL
