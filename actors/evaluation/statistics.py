"""Rates, ratios and means with 95 % confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import special

CONFIDENCE = 0.95


class Estimate(NamedTuple):
    """A value with its 95 % confidence interval."""

    value: float
    low: float
    high: float


def dispersion(samples: Iterable[Sequence[tuple[int, int]]], freedom: float = math.inf) -> float:
    """Estimates the dispersion factor of counts: their variance over the binomial one.

    This is Pearson's estimate (McCullagh and Nelder 1989, 4.5.2), pooled over samples that share the factor. Because
    the factor is itself an estimate, it is multiplied by the squared ratio of Student's quantile to the normal one.

    Args:
      samples: samples of several (count, total) pairs each, with one rate per sample. A sample of a single pair, or
        whose rate is 0 or 1, is ignored.
      freedom: upper limit on the degrees of freedom, for pairs that depend on each other across samples.

    Returns:
      The factor, at least 1; exactly 1 if no sample has information about it.
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
    """Student's quantile; the normal one for infinite `freedom`. `scipy.stats` would take half a second to import."""
    share = 0.5 + CONFIDENCE / 2
    return float(special.ndtri(share) if math.isinf(freedom) else special.stdtrit(freedom, share))


Z = _quantile(math.inf)


def as_percent(share: Estimate) -> str:
    """Formats a rate with its interval, such as `89.8 % (87.8 … 91.5)`."""
    value, low, high = (100 * number for number in share)
    return f"{value:.1f} % ({low:.1f} … {high:.1f})"


def rate(count: int, total: int, spread: float = 1.0) -> Estimate:
    """Success rate with its score interval (Wilson 1927).

    Args:
      count: number of successes.
      total: number of trials.
      spread: dispersion factor of the counts (see `dispersion`); the interval is that of `total / spread` trials.

    Raises:
      ValueError: there are no trials, or more successes than trials.
    """
    if total < 1 or not 0 <= count <= total:
        raise ValueError(f"a rate needs trials, and at most as many successes, not {count} of {total}")
    share, trials = count / total, total / spread
    centre = (share + Z * Z / (2 * trials)) / (1 + Z * Z / trials)
    half = Z / (1 + Z * Z / trials) * math.sqrt(share * (1 - share) / trials + Z * Z / (4 * trials * trials))
    low, high = (0.0 if count == 0 else centre - half), (1.0 if count == total else centre + half)
    return Estimate(share, low, high)


def ratio(samples: Sequence[Sequence[tuple[int, int]]]) -> Estimate:
    """Ratio of all counts to all totals where the totals vary too: the combined ratio estimator (Cochran 1977, 6.11).

    Args:
      samples: strata of (count, total) pairs, such as one pair per training seed; not all totals are 0.

    Returns:
      The ratio with its 95 % interval: Student's t interval over the pairs of each stratum, or Wilson's if that is
      wider.
    """
    count, total = (sum(pair[i] for pairs in samples for pair in pairs) for i in (0, 1))
    binomial = rate(count, total)
    variance, freedom = 0.0, 0
    for pairs in samples:
        residuals = np.array([pair[0] - binomial.value * pair[1] for pair in pairs])
        if len(residuals) > 1:
            variance += len(residuals) * float(np.var(residuals, ddof=1))
            freedom += len(residuals) - 1
    half = _quantile(freedom) * math.sqrt(variance) / total if freedom else 0.0
    low, high = min(binomial.low, max(binomial.value - half, 0.0)), max(binomial.high, min(binomial.value + half, 1.0))
    return Estimate(binomial.value, low, high)


def rate_of_worlds(pairs: Sequence[tuple[int, int]]) -> Estimate:
    """Success rate of robots that share the fate of their worlds, with the interval of worlds.

    Args:
      pairs: (successes, robots) of every world. Where all robots succeed, or none, nothing tells how much those of one
        world have in common; a world then counts as one trial.
    """
    count, total = (sum(pair[i] for pair in pairs) for i in (0, 1))
    if total == len(pairs):
        return rate(count, total)
    knows = len(pairs) > 1 and 0 < count < total
    return rate(count, total, dispersion([pairs]) if knows else total / len(pairs))


def success_rate(successes: np.ndarray) -> Estimate:
    """Share of the successes `[worlds, learners]` bool (see `rate_of_worlds`)."""
    return rate_of_worlds([(int(count), successes.shape[1]) for count in successes.sum(axis=1)])


class PairedComparison(NamedTuple):
    """Two players on the same start scenes: the difference of their success rates, and the sign test's p-value.

    `won` and `lost` count the worlds in which one of the two alone had success; where several robots of a world learn,
    had more.
    """

    difference: Estimate
    won: int
    lost: int
    p_value: float


def paired_comparison(first: np.ndarray, second: np.ndarray) -> PairedComparison:
    """Compares the successes `[worlds]` or `[worlds, learners]` bool of two players in the same worlds.

    The interval of the difference of the rates, second less first, is that of Bonett and Price (2012, "Adjusted Wald
    confidence interval for a difference of binomial proportions based on paired data"); where several robots of a world
    learn, also Student's t interval over the worlds, if that reaches further. The sign test is the exact binomial test
    of the worlds that one of the two won (McNemar 1947).

    Raises:
      ValueError: the numbers of worlds or robots differ, or there are none.
    """
    if first.shape != second.shape or first.size == 0:
        raise ValueError(f"paired results need equally many episodes, not {first.shape} and {second.shape}")
    first, second = first.reshape(len(first), -1), second.reshape(len(second), -1)
    learners = first.shape[1]
    estimate = _difference(first.size, int((second & ~first).sum()), int((first & ~second).sum()))
    more = second.sum(axis=1) - first.sum(axis=1)
    if learners > 1:
        of_worlds = mean(more / learners)
        estimate = estimate._replace(
            low=max(-1.0, min(estimate.low, of_worlds.low)), high=min(1.0, max(estimate.high, of_worlds.high))
        )
    won, lost = int((more > 0).sum()), int((more < 0).sum())
    p_value = min(1.0, 2 * float(special.bdtr(min(won, lost), won + lost, 0.5))) if won + lost else 1.0
    return PairedComparison(estimate, won, lost, p_value)


def _difference(total: int, won: int, lost: int) -> Estimate:
    """The difference of two rates of `total` pairs, of which one player alone won `won`, the other `lost`."""
    up, down = (won + 1) / (total + 2), (lost + 1) / (total + 2)
    half = Z * math.sqrt((up + down - (up - down) ** 2) / (total + 2))
    return Estimate((won - lost) / total, max(-1.0, up - down - half), min(1.0, up - down + half))


def mean(values: np.ndarray) -> Estimate:
    """Mean of `values` `[count]` with its Student t interval, which has width 0 for a single value."""
    centre = float(np.mean(values))
    if len(values) < 2:
        return Estimate(centre, centre, centre)
    half = _quantile(len(values) - 1) * np.std(values, ddof=1) / math.sqrt(len(values))
    return Estimate(centre, float(centre - half), float(centre + half))


def mean_share(shares: np.ndarray) -> Estimate:
    """`mean` of `shares` `[count]` in 0..1, whose interval ends there, too."""
    return Estimate(*(float(bound) for bound in np.clip(mean(shares), 0.0, 1.0)))
