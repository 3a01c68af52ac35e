"""Rates and means with their 95 % confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats as scipy_stats

CONFIDENCE = 0.95


class Estimate(NamedTuple):
    """A value with its 95 % confidence interval."""

    value: float
    low: float
    high: float


class Dispersion(NamedTuple):
    """How much more counts vary than binomial ones would: factor of the variance, and its degrees of freedom."""

    factor: float = 1.0
    freedom: float = math.inf


BINOMIAL = Dispersion()


def dispersion(samples: Iterable[Sequence[tuple[int, int]]], freedom: float = math.inf) -> Dispersion:
    """Pearson's estimate over samples that share it, each several (count, total) of one share (McCullagh and Nelder).

    Args:
      samples: the samples; those of one pair, or whose counts are all 0 or all whole, tell nothing.
      freedom: at most so many degrees of freedom, where pairs of different samples depend on each other.

    Returns:
      The dispersion, never below binomial; binomial if nothing tells of it.
    """
    chi_square, found = 0.0, 0
    for pairs in samples:
        counts, totals = np.array(pairs, np.float64).reshape(-1, 2).T
        share = counts.sum() / totals.sum() if len(pairs) > 1 else 0.0
        if 0.0 < share < 1.0:
            chi_square += float(np.sum((counts - totals * share) ** 2 / (totals * share * (1 - share))))
            found += len(pairs) - 1
    factor = chi_square / found if found else 1.0
    return Dispersion(factor, min(found, freedom)) if factor > 1.0 else BINOMIAL


def as_percent(share: Estimate) -> str:
    """`89.8 % (87.8 … 91.5)`."""
    value, low, high = (100 * number for number in share)
    return f"{value:.1f} % ({low:.1f} … {high:.1f})"


def rate(count: int, total: int, spread: Dispersion = BINOMIAL) -> Estimate:
    """Share of successes with its Wilson interval (Wilson 1927).

    Args:
      count: successes.
      total: trials.
      spread: where counts vary more than binomial ones, so many trials are worth `total` over its factor.

    Raises:
      ValueError: there are no trials.
    """
    if total < 1 or not 0 <= count <= total:
        raise ValueError(f"a rate needs trials, and at most as many successes, not {count} of {total}")
    share, trials = count / total, total / spread.factor
    z = float(scipy_stats.t.ppf(0.5 + CONFIDENCE / 2, spread.freedom))
    centre = (share + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z / (1 + z * z / trials) * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    low, high = (0.0 if count == 0 else centre - half), (1.0 if count == total else centre + half)
    return Estimate(share, low, high)


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
