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


def dispersion(samples: Iterable[Sequence[tuple[int, int]]], freedom: float = math.inf) -> float:
    """How many times as much counts vary as binomial ones: Pearson's estimate (McCullagh and Nelder 1989, 4.5.2).

    It is taken for the counts of several samples that share it, and larger by the square of Student's quantile over the
    normal one, since it is an estimate itself.

    Args:
      samples: the samples, each several (count, total) of one share; those of one pair, or whose counts are all 0 or
        all whole, tell nothing.
      freedom: at most so many degrees of freedom, where pairs of different samples depend on each other.

    Returns:
      The factor, at least 1; 1 if nothing tells of it.
    """
    chi_square, found = 0.0, 0
    for pairs in samples:
        counts, totals = np.array(pairs, np.float64).reshape(-1, 2).T
        share = counts.sum() / totals.sum() if len(pairs) > 1 else 0.0
        if 0.0 < share < 1.0:
            chi_square += float(np.sum((counts - totals * share) ** 2 / (totals * share * (1 - share))))
            found += len(pairs) - 1
    return max(1.0, chi_square / found * (_quantile(min(found, freedom)) / Z) ** 2) if found else 1.0


def _quantile(freedom: float) -> float:
    return float(scipy_stats.t.ppf(0.5 + CONFIDENCE / 2, freedom))


Z = _quantile(math.inf)


def as_percent(share: Estimate) -> str:
    """`89.8 % (87.8 … 91.5)`."""
    value, low, high = (100 * number for number in share)
    return f"{value:.1f} % ({low:.1f} … {high:.1f})"


def rate(count: int, total: int, spread: float = 1.0) -> Estimate:
    """Share of successes with its Wilson interval (Wilson 1927).

    Args:
      count: successes.
      total: trials.
      spread: so many trials are worth one, where counts vary more than binomial ones; see `dispersion`.

    Raises:
      ValueError: there are no trials, or more successes.
    """
    if total < 1 or not 0 <= count <= total:
        raise ValueError(f"a rate needs trials, and at most as many successes, not {count} of {total}")
    share, trials = count / total, total / spread
    centre = (share + Z * Z / (2 * trials)) / (1 + Z * Z / trials)
    half = Z / (1 + Z * Z / trials) * math.sqrt(share * (1 - share) / trials + Z * Z / (4 * trials * trials))
    low, high = (0.0 if count == 0 else centre - half), (1.0 if count == total else centre + half)
    return Estimate(share, low, high)


def ratio(samples: Sequence[Sequence[tuple[int, int]]]) -> Estimate:
    """Share of all counts in all totals, where totals vary too; samples are strata (Cochran 1977, 6.11).

    Args:
      samples: each several (count, total) of one kind, such as one a training seed; at least one total is not 0.

    Returns:
      The share with its 95 % interval: Student's over the pairs of each sample, or Wilson's if that is wider.
    """
    count, total = (sum(pair[i] for pairs in samples for pair in pairs) for i in (0, 1))
    binomial = rate(count, total)
    variance, freedom = 0.0, 0
    for pairs in samples:
        left = np.array([part - binomial.value * whole for part, whole in pairs])
        if len(left) > 1:
            variance += len(left) * float(np.var(left, ddof=1))
            freedom += len(left) - 1
    half = _quantile(freedom) * math.sqrt(variance) / total if freedom else 0.0
    low, high = min(binomial.low, max(binomial.value - half, 0.0)), max(binomial.high, min(binomial.value + half, 1.0))
    return Estimate(binomial.value, low, high)


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
