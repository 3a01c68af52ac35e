"""Pooled cells, and intervals of differences and means, against published numbers and simulation."""

from __future__ import annotations

import numpy as np
import pytest

from actors.evaluation.statistics import Estimate, rate
from dashboards.analysis.aggregate import (
    GROUPS,
    Measurement,
    PooledCell,
    Results,
    Setup,
    average,
    captured,
    difference,
    lost,
    over_groups,
    over_robots,
    success,
    weighted_sum,
)
from sim_core.checks import ConfigError
from sim_core.outcomes import Outcome
from tests.dashboards.tables import claimed_table, fixed, row

HOME = Setup(10, 2)


def of(count: int, total: int) -> Measurement:
    return Measurement(rate(count, total), total)


def test_seeds_are_pooled_by_their_counts():
    rows = [row("sensor", HOME, success=90), row("sensor", HOME, success=60, seed=1, episodes=1000)]
    cell = Results(rows).fixed("sensor", HOME)
    assert cell is not None
    assert (cell.episodes, cell.count(Outcome.GOAL)) == (4000, 2700 + 600)
    measured = success(cell)
    assert measured.estimate.value == 3300 / 4000
    assert (measured.seeds, measured.seed_range) == (2, (0.6, 0.9))
    assert cell.failures().estimate.value == pytest.approx(700 / 4000)


def test_one_seed_has_no_range():
    cell = Results([row("sensor", HOME, success=90)]).fixed("sensor", HOME)
    assert cell is not None and success(cell).seed_range is None


@pytest.mark.parametrize("rates", [[0.8] * 5, [0.95, 0.85, 0.7, 0.6, 0.4]])
def test_intervals_over_seeds_cover_the_methods_mean_not_that_of_these_policies(rates: list[float]):
    """True rates of policies vary (beta distributed). A rate's interval covers the mean over all possible policies."""
    rng, hits, binomial, rounds = np.random.default_rng(2), 0, 0, 300
    for _ in range(rounds):
        rows = [
            row("out", Setup(5, groups), success=100 * rng.binomial(3000, share) / 3000, seed=seed)
            for groups, truth in zip(GROUPS, rates, strict=True)
            for seed, share in enumerate(rng.beta(60 * truth, 60 * (1 - truth), 3))
        ]
        results = Results(rows)
        for groups, truth in zip(GROUPS, rates, strict=True):
            cell = results.fixed("out", Setup(5, groups))
            assert cell is not None
            estimate, naive = success(cell).estimate, rate(cell.count(Outcome.GOAL), cell.episodes)
            hits += estimate.low <= truth <= estimate.high
            binomial += naive.low <= truth <= naive.high
    assert 0.93 <= hits / (rounds * len(rates)) <= 0.97
    assert binomial / (rounds * len(rates)) < 0.4


def test_one_methods_overdispersion_does_not_widen_anothers_intervals():
    rows = [row("sensor", HOME, success=90, seed=seed) for seed in (0, 1)]
    rows += [row("out", HOME, success=success_percent, seed=seed) for seed, success_percent in enumerate((95, 50))]
    results = Results(rows)
    steady, shaky = (results.fixed(method, HOME) for method in ("sensor", "out"))
    assert steady is not None and shaky is not None
    assert success(steady).estimate == rate(5400, 6000)
    assert success(shaky).estimate.low < 0.4
    assert shaky.failures().estimate.high == pytest.approx(1 - success(shaky).estimate.low)


def test_cells_are_told_apart_by_method_training_and_setup():
    results = Results(
        [
            row("sensor", HOME, success=10),
            row("out", HOME, success=20),
            row("sensor", HOME, success=30, trained=Setup(5, 2)),
            row("sensor", HOME, success=40)._replace(policy="orca"),
        ]
    )
    ways = (results.fixed("sensor", HOME), results.fixed("out", HOME))
    ways += (results.transferred("sensor", Setup(5, 2), HOME), results.transferred("sensor", HOME, HOME))
    assert [success(cell).estimate.value for cell in ways if cell] == [0.1, 0.2, 0.3, 0.1]
    assert results.fixed("in", HOME) is None and results.transferred("sensor", HOME, Setup(5, 2)) is None
    assert len(results.cells()) == 3


def test_refuses_a_seed_twice():
    with pytest.raises(ConfigError, match="10r×2g .* twice"):
        Results([row("sensor", HOME, success=90), row("sensor", HOME, success=80)])


@pytest.mark.parametrize(
    ("first", "second", "low", "high"),
    [
        ((56, 70), (48, 80), 0.0524, 0.3339),
        ((9, 10), (3, 10), 0.1705, 0.8090),
        ((6, 7), (2, 7), 0.0582, 0.8062),
        ((5, 56), (0, 29), -0.0381, 0.1926),
        ((0, 10), (0, 20), -0.1611, 0.2775),
        ((10, 10), (0, 20), 0.6791, 1.0),
    ],
)
def test_difference_against_published_numbers(first: tuple[int, int], second: tuple[int, int], low: float, high: float):
    """R. G. Newcombe 1998, "Interval estimation for the difference between independent proportions", Table II (10)."""
    found = difference(of(*first), of(*second))
    assert found is not None
    one, two = rate(*first), rate(*second)
    value = first[0] / first[1] - second[0] / second[1]
    assert found.estimate == pytest.approx(Estimate(value, low, high), abs=5e-5)
    below, above = (
        np.hypot(one.value - one.low, two.high - two.value),
        np.hypot(one.high - one.value, two.value - two.low),
    )
    assert found.estimate == pytest.approx((value, value - below, value + above))
    assert found.episodes == first[1] + second[1]


def test_a_swapped_difference_changes_its_sign():
    forth, back = difference(of(7, 30), of(50, 90)), difference(of(50, 90), of(7, 30))
    assert forth is not None and back is not None
    assert forth.estimate == pytest.approx((-back.estimate.value, -back.estimate.high, -back.estimate.low))


def test_the_mean_weights_cells_equally():
    found = average([of(100, 100), of(0, 900)])
    assert found is not None and found.estimate.value == pytest.approx(0.5)


def test_the_interval_of_a_mean_has_its_coverage():
    truth, rng = np.array([0.02, 0.1, 0.3, 0.5, 0.9]), np.random.default_rng(0)
    hits = 0
    for counts in rng.binomial(100, truth, size=(1000, 5)):
        found = average([of(int(count), 100) for count in counts])
        assert found is not None
        hits += found.estimate.low <= truth.mean() <= found.estimate.high
    assert 0.93 <= hits / 1000 <= 0.98


def test_the_interval_of_lost_minus_captured_uses_their_correlation():
    """An interval that took the two as independent would cover only 90 % here."""
    rng = np.random.default_rng(1)
    hits = 0
    for gone, taken, _ in rng.multinomial(200, [0.3, 0.3, 0.4], size=2000):
        made = row("sensor", HOME, success=0, episodes=200)._replace(lost=int(gone), captured=int(taken))
        estimate = PooledCell((made,)).lost_minus_captured().estimate
        hits += estimate.low <= 0.0 <= estimate.high
    assert 0.935 <= hits / 2000 <= 0.97


def test_lost_minus_captured_at_its_limits():
    none = PooledCell((row("sensor", HOME, success=100),)).lost_minus_captured().estimate
    assert none.value == 0 and none.low == -none.high
    only = PooledCell((row("sensor", HOME, success=0, lost=100),)).lost_minus_captured().estimate
    assert only.value == 1 and only.low > 0.99


def test_a_missing_term_makes_the_sum_missing():
    assert weighted_sum([(1.0, of(1, 2)), (-1.0, None)]) is None
    assert average([None, of(1, 2)]) is None


def test_means_over_groups_and_over_robots_by_hand():
    results = Results(claimed_table())
    found = [
        over_groups(results, "sensor", 5, lost),
        over_groups(results, "sensor", 10, captured),
        over_robots(results, "sensor", 8, lost),
        over_robots(results, "out", 1, success),
    ]
    values = [measured.estimate.value for measured in found if measured]
    assert values == pytest.approx([0.136, 0.018, 0.104, 0.982])
    assert over_groups(Results([fixed("sensor", Setup(5, m)) for m in GROUPS[:4]]), "sensor", 5, lost) is None
