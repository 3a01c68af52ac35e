"""Rates and means with their 95 % confidence intervals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import stats as scipy_stats

CONFIDENCE = 0.95


class Estimate(NamedTuple):
    """A value with its 95 % confidence interval."""

    value: float
    low: float
    high: float


def as_percent(share: Estimate) -> str:
    """`89.8 % (87.8 … 91.5)`."""
    value, low, high = (100 * number for number in share)
    return f"{value:.1f} % ({low:.1f} … {high:.1f})"


def rate(count: int, total: int) -> Estimate:
    """Share of successes with its Wilson interval (Wilson 1927).

    Raises:
      ValueError: there are no trials.
    """
    interval = scipy_stats.binomtest(count, total).proportion_ci(CONFIDENCE, method="wilson")
    return Estimate(count / total, float(interval.low), float(interval.high))


def rate_difference(first: tuple[int, int], second: tuple[int, int]) -> Estimate:
    """Rate of `first` less that of `second`, each (count, total), with Newcombe's interval (1998, method 10).

    Raises:
      ValueError: one of them has no trials.
    """
    one, two = rate(*first), rate(*second)
    value = one.value - two.value
    low = value - float(np.hypot(one.value - one.low, two.high - two.value))
    high = value + float(np.hypot(one.high - one.value, two.value - two.low))
    return Estimate(value, low, high)


def mean(values: np.ndarray) -> Estimate:
    """Mean with its Student t interval; the interval is the value where it has no width."""
    centre = float(np.mean(values))
    if len(values) < 2:
        return Estimate(centre, centre, centre)
    half = scipy_stats.t.ppf(0.5 + CONFIDENCE / 2, len(values) - 1) * scipy_stats.sem(values)
    return Estimate(centre, float(centre - half), float(centre + half))
