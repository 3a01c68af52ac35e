"""Rates and means with their intervals, against closed forms and published numbers."""

import math

import numpy as np
import pytest
from scipy import stats

from actors.transitions import NO_OUTCOME, EpisodeStats
from learner.results import as_metrics, final_metrics, mean, outcome_label, rate, summarise
from sim_core.outcomes import ENDED, Outcome


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


def episodes(outcomes):
    count = len(outcomes)
    return EpisodeStats(np.array(outcomes, np.int8), np.arange(1, count + 1, dtype=np.int32), np.arange(count) / 2)


def test_every_outcome_has_its_rate_and_they_sum_to_one():
    evaluation = summarise(episodes([1, 1, 1, 2, 4, 4, 5, 1]))
    shares = {kind: estimate.value for kind, estimate in evaluation.rates.items()}
    assert shares == {
        Outcome.GOAL: 0.5,
        Outcome.LOST: 0.125,
        Outcome.CAPTURED: 0.0,
        Outcome.COLLISION: 0.25,
        Outcome.TIMEOUT: 0.125,
    }
    assert sum(shares.values()) == 1 and tuple(shares) == ENDED and evaluation.episodes == 8
    assert evaluation.episode_length.value == 4.5 and evaluation.episode_return.value == 1.75


def test_metrics_of_our_environment():
    metrics = as_metrics(summarise(episodes([1, 1, 2, 5])))
    names = ["success_rate", "lost_rate", "captured_rate", "collision_rate", "timeout_rate"]
    assert [outcome_label(kind) for kind in ENDED] == names
    bounds = {f"{name}{end}" for name in names for end in ("", "_low", "_high")}
    assert metrics.keys() == bounds | {"return", "episode_length"}
    assert metrics["success_rate"] == 0.5 and metrics["success_rate_low"] == pytest.approx(wilson(2, 4)[0])


@pytest.mark.parametrize("outcomes", [[NO_OUTCOME] * 4, [NO_OUTCOME, 1, 1, 1]])
def test_metrics_of_an_environment_without_outcomes(outcomes):
    evaluation = summarise(episodes(outcomes))
    assert evaluation.rates == {}
    metrics = as_metrics(evaluation)
    assert metrics.keys() == {"return", "return_low", "return_high", "episode_length"}
    assert metrics["return_low"] < metrics["return"] == 0.75 < metrics["return_high"]


def test_no_episodes_are_refused():
    with pytest.raises(ValueError, match="no episodes"):
        summarise(episodes([]))


def test_final_metrics_leave_out_the_failures_intervals():
    evaluation = summarise(episodes([1, 1, 2, 5]))
    every, final = as_metrics(evaluation), final_metrics(evaluation)
    ends = {f"{name}_rate{end}" for name in ("lost", "captured", "collision", "timeout") for end in ("_low", "_high")}
    assert final == {name: value for name, value in every.items() if name not in ends}
    assert {"success_rate_low", "success_rate_high", "lost_rate"} <= final.keys()
    plain = summarise(episodes([NO_OUTCOME] * 3))
    assert final_metrics(plain) == as_metrics(plain)
