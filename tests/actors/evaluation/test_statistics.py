"""Rates, ratios and means with intervals, compared with closed forms and published numbers."""

import math

import numpy as np
import pytest
from scipy import stats

from actors.evaluation.statistics import dispersion, mean, mean_share, paired_comparison, rate, ratio, success_rate


def wilson(count, total):
    """Score interval of E. B. Wilson (1927), written out."""
    z, share = stats.norm.ppf(0.975), count / total
    centre = (share + z * z / (2 * total)) / (1 + z * z / total)
    half = z / (1 + z * z / total) * math.sqrt(share * (1 - share) / total + z * z / (4 * total * total))
    return centre - half, centre + half


@pytest.mark.parametrize(("count", "total"), [(0, 1), (1, 1), (0, 20), (20, 20), (3, 7), (81, 263), (997, 1000)])
def test_a_rate_has_wilsons_interval(count, total):
    value, low, high = rate(count, total)
    assert value == count / total
    assert (low, high) == pytest.approx(wilson(count, total), abs=1e-12)
    assert 0 <= low <= value <= high <= 1


def test_rates_against_published_numbers():
    # R. G. Newcombe (1998), Table I, method 3 (score without continuity correction).
    for count, total, low, high in ((81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0, 0.1611)):
        assert rate(count, total)[1:] == pytest.approx((low, high), abs=5e-5)


def test_a_rate_without_trials_is_refused():
    with pytest.raises(ValueError):
        rate(0, 0)


def test_a_mean_has_students_interval():
    values = np.random.default_rng(0).normal(3, 2, 12)
    half = stats.t.interval(0.95, 11, loc=values.mean(), scale=values.std(ddof=1) / math.sqrt(12))
    assert mean(values).value == pytest.approx(values.mean())
    assert mean(values)[1:] == pytest.approx(half)
    # Five values by hand: mean 3, s = sqrt(2.5), t(0.975, 4) = 2.776.
    assert mean(np.arange(1, 6))[1:] == pytest.approx((3 - 2.7764 * 0.70711, 3 + 2.7764 * 0.70711), abs=1e-3)


def test_the_interval_of_a_mean_share_ends_at_0_and_1():
    assert mean_share(np.array([1.0, 1.0, 0.9]))[::2] == (pytest.approx(2.9 / 3), 1.0)
    assert mean_share(np.array([0.0, 0.0, 0.1]))[1] == 0.0
    assert mean_share(np.array([0.4, 0.5, 0.6])) == pytest.approx(mean(np.array([0.4, 0.5, 0.6])))


@pytest.mark.parametrize("values", [[2.5], [2.5, 2.5, 2.5]])
def test_the_interval_of_a_mean_without_variance_has_width_zero(values):
    assert mean(np.array(values)) == (2.5, 2.5, 2.5)


def test_overdispersed_counts_are_worth_fewer_trials():
    assert rate(300, 1000, 5.0) == pytest.approx(rate(60, 200))


def test_dispersion_is_pearsons_chi_square_times_students_correction():
    samples = [[(10, 100), (30, 100)], [(5, 50), (9, 80), (20, 90)]]
    tables = [np.array([(count, total - count) for count, total in pairs]) for pairs in samples]
    chi_square = sum(stats.chi2_contingency(table, correction=False).statistic for table in tables)
    for freedom, most in ((3, math.inf), (2, 2)):
        student = stats.t.ppf(0.975, freedom) / stats.norm.ppf(0.975)
        assert dispersion(samples, most) == pytest.approx(chi_square / 3 * student**2)


@pytest.mark.parametrize("samples", [[], [[(3, 10)]], [[(0, 10), (0, 20)], [(10, 10), (5, 5)]], [[(5, 10), (5, 10)]]])
def test_samples_without_information_give_binomial_dispersion(samples):
    assert dispersion(samples) == 1.0


def test_the_interval_of_a_ratio_has_its_nominal_coverage():
    """The strata have very different totals and rates; each has three clusters that differ by more than chance."""
    rng, strata, hits, naive = np.random.default_rng(3), np.array([(900, 0.8), (300, 0.6), (60, 0.3)] * 4), 0, 0
    truth = strata.prod(axis=1).sum() / strata[:, 0].sum()
    for _ in range(1000):
        samples = []
        for mean_total, share in strata:
            totals = rng.poisson(mean_total * rng.uniform(0.5, 1.5, 3))
            samples.append(list(zip(rng.binomial(totals, rng.normal(share, 0.05, 3)), totals, strict=True)))
        found = ratio(samples)
        plain = rate(*np.sum(samples, axis=(0, 1)).tolist())
        hits += found.low <= truth <= found.high
        naive += plain.low <= truth <= plain.high
    assert 0.935 <= hits / 1000 <= 0.975
    assert naive / 1000 < 0.8


def test_a_ratio_without_clusters_equals_a_rate():
    assert ratio([[(3, 10)], [(5, 20)]]) == rate(8, 30)
    assert ratio([[(5, 10), (5, 10)]]) == rate(10, 20), "never narrower than binomial"


def flags(both, won, lost, neither):
    """(first, second): successes of two players in as many episodes of each kind."""
    first = np.repeat([True, False, True, False], (both, won, lost, neither))
    second = np.repeat([True, True, False, False], (both, won, lost, neither))
    return first, second


def test_a_paired_difference_is_that_of_bonett_and_price():
    found = paired_comparison(*flags(36, 3, 12, 49))
    up, down = 4 / 102, 13 / 102  # written out: p12 and p21 with one episode added to each
    half = stats.norm.ppf(0.975) * math.sqrt((up + down - (up - down) ** 2) / 102)
    assert found.difference == pytest.approx((-0.09, up - down - half, up - down + half))
    assert (found.won, found.lost) == (3, 12)
    sign = 2 * sum(math.comb(15, k) for k in range(4)) / 2**15
    assert found.p_value == pytest.approx(sign)


def test_equal_players_do_not_differ():
    found = paired_comparison(*flags(7, 0, 0, 3))
    assert found.difference.value == 0 and found.difference.low < 0 < found.difference.high
    assert (found.won, found.lost, found.p_value) == (0, 0, 1.0)
    for first, second in (([], []), ([True], [True, False])):
        with pytest.raises(ValueError, match="equally many"):
            paired_comparison(np.array(first, bool), np.array(second, bool))


def test_the_paired_interval_has_its_coverage_and_is_narrower_than_an_unpaired_one():
    rng, hits, narrower = np.random.default_rng(0), 0, 0
    for _ in range(2_000):
        first = rng.random(300) < 0.9
        second = np.where(rng.random(300) < 0.9, first, rng.random(300) < 0.7)  # they share most episodes
        found = paired_comparison(first, second)
        hits += found.difference.low <= 0.1 * (0.7 - 0.9) <= found.difference.high
        ends = [rate(int(player.sum()), 300) for player in (first, second)]
        unpaired = math.sqrt(sum((end.high - end.low) ** 2 for end in ends))
        narrower += found.difference.high - found.difference.low < unpaired
    assert 0.94 <= hits / 2_000 <= 0.97
    assert narrower == 2_000


def fates(rng, shares, learners):
    """Successes `[worlds, learners]` of worlds whose robots have one chance, which is 0 or 1 for half of them."""
    chance = rng.choice([0.0, 1.0, *shares], p=[0.25, 0.25, *(0.5 / len(shares) for _ in shares)], size=200)
    return rng.random((200, learners)) < chance[:, None]


def test_robots_of_one_world_are_no_independent_trials():
    rng = np.random.default_rng(5)
    covered, differs, significant, naive = 0, 0, 0, 0
    for _ in range(400):
        first, second = fates(rng, [0.5], 10), fates(rng, [0.5], 10)
        alone, found = success_rate(first), paired_comparison(first, second)
        covered += alone.low <= 0.5 <= alone.high
        differs += not found.difference.low <= 0 <= found.difference.high
        significant += found.p_value < 0.05
        naive += paired_comparison(first.ravel(), second.ravel()).p_value < 0.05
        assert found.difference.value == pytest.approx(second.mean() - first.mean())
    assert 0.92 < covered / 400 < 0.98 and differs / 400 < 0.08 and significant / 400 < 0.08 and naive / 400 > 0.3


@pytest.mark.parametrize("all_succeed", [True, False])
def test_worlds_are_trials_where_all_robots_have_one_fate(all_succeed):
    found, worlds = success_rate(np.full((12, 10), all_succeed)), rate(12 * all_succeed, 12)
    assert found == pytest.approx(worlds)


def test_one_robot_a_world_is_an_episode():
    first, second = flags(36, 3, 12, 49)
    assert success_rate(first[:, None]) == rate(48, 100)
    assert paired_comparison(first[:, None], second[:, None]) == paired_comparison(first, second)
