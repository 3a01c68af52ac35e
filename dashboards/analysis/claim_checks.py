"""The checks that a claim consists of: each a measured quantity that must lie in a range, and its verdict.

All tolerances of the claims are defined here:

- `≈ x %` of a success rate, read from a bar chart: within 10 points of x. Of a failure rate: within 2 points.
- "flat", "similar": differs by at most 2 points.
- "none", "the only": at most 0.5 %, which a bar chart cannot tell from none.
- "decays fast": falls by more than with 10 and 15 robots do in the mean, whose decay the text calls smoother.
- "outperforms" in every setup: the value is higher. Where both rates are at least 95 %, the text's bars cannot be told
  apart: there the other may be higher by 2 points. It fails only where the interval for all comparisons together
  (Bonferroni) is below.
- "almost every": at least 80 %. "does not vanish": at least half. "close to zero": at most 10 %.

A check holds if its whole 95 % interval lies in the range, fails if none of it does, and is undecided otherwise.
`≈`, "around" and "none" are judged by the value alone: they hold if the value lies in the range, fail if the whole
interval lies outside, and are undecided otherwise. The intervals are those of single checks. Of 50 checks whose truth
lies on the limit, one or two are expected to fail by chance.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from typing import NamedTuple

from actors.evaluation.statistics import Estimate, as_percent
from dashboards.analysis.aggregate import Measurement, Setup, difference, for_comparisons

ABOUT = 0.10
ABOUT_FAILURE = 0.02
ALIKE = 0.02
NONE = 0.005
NEAR_ALL = 0.95
ALMOST_EVERY = 0.80
NOT_VANISHED = 0.50
CLOSE_TO_ZERO = 0.10
NUM_CLAIMS = 15
"""Claims of the dissertation; those with higher numbers are further statements."""


class Verdict(enum.StrEnum):
    """Verdict on a check or a claim."""

    HOLDS = "holds"
    FAILS = "does not hold"
    UNDECIDED = "undecided"
    NO_DATA = "no data"


class Unit(enum.StrEnum):
    """In what a quantity is shown: a rate, a difference of rates, or a reward (the dissertation's tau is 1)."""

    PERCENT = "%"
    POINTS = "points"
    REWARD = "τ"


class Check(NamedTuple):
    """One quantity of a claim and the range [low, high] in which the claim puts it.

    Fields: name, short and unique in its claim; the range in words; the measured quantity, None without data; its
    limits; whether the value alone decides (`≈`); in what it is shown; the setup of the check, if the claim is about
    every setup; what would give data that no table of results holds.
    """

    name: str
    wanted: str
    measured: Measurement | None
    low: float = -math.inf
    high: float = math.inf
    by_value: bool = False
    unit: Unit = Unit.PERCENT
    setup: Setup | None = None
    needs: str = ""

    @property
    def verdict(self) -> Verdict:
        """Whether the quantity lies in the range."""
        if self.measured is None:
            return Verdict.NO_DATA
        value, low, high = self.measured.estimate
        if (self.low <= value <= self.high) if self.by_value else (self.low <= low and high <= self.high):
            return Verdict.HOLDS
        return Verdict.FAILS if high < self.low or low > self.high else Verdict.UNDECIDED

    @property
    def distance(self) -> float | None:
        """How far the value is outside the range, as a share; 0 inside, None without data."""
        if self.measured is None:
            return None
        value = self.measured.estimate.value
        return max(self.low - value, value - self.high, 0.0)


class Claim(NamedTuple):
    """One of the dissertation's claims with its checks."""

    number: int
    text: str
    checks: list[Check]

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of the checks: one that fails refutes the claim, whatever data are missing."""
        found = {check.verdict for check in self.checks}
        worst_first = (Verdict.FAILS, Verdict.NO_DATA, Verdict.UNDECIDED)
        return next((verdict for verdict in worst_first if verdict in found), Verdict.HOLDS)


def distance(claims: Sequence[Claim]) -> float | None:
    """The sum over the dissertation's claims of the mean distance of their checks from their ranges, as a share.

    Checks without data are left out, and further statements; None where no check has data.
    """
    distances = [
        [check.distance for check in claim.checks if check.distance is not None]
        for claim in claims
        if claim.number <= NUM_CLAIMS
    ]
    known = [sum(each) / len(each) for each in distances if each]
    return sum(known) if known else None


def about(name: str, measured: Measurement | None, value: float, tolerance: float = ABOUT) -> Check:
    """`≈ value`: the rate lies within `tolerance`."""
    low, high = max(round(value - tolerance, 6), 0.0), min(round(value + tolerance, 6), 1.0)
    wanted = f"≈ {_plain(value)} % ({_plain(low)} … {_plain(high)} %)"
    return Check(name, wanted, measured, low, high, by_value=True)


def around_or_more(name: str, measured: Measurement | None, value: float) -> Check:
    """`around value or more`: as `about`, without an upper limit."""
    low = round(value - ABOUT, 6)
    return Check(name, f"around {_plain(value)} % or more (≥ {_plain(low)} %)", measured, low, by_value=True)


def at_least(name: str, measured: Measurement | None, limit: float) -> Check:
    """The rate is `limit` or more."""
    return Check(name, f"≥ {_plain(limit)} %", measured, low=limit)


def at_most(name: str, measured: Measurement | None, limit: float) -> Check:
    """The rate is `limit` or less."""
    return Check(name, f"≤ {_plain(limit)} %", measured, high=limit)


def none(name: str, measured: Measurement | None) -> Check:
    """The rate cannot be told from 0."""
    return Check(name, f"none (≤ {_plain(NONE)} %), by value", measured, high=NONE, by_value=True)


def rises(name: str, measured: Measurement | None) -> Check:
    """The difference is greater than 0."""
    return Check(name, "> 0 points", measured, low=0.0, unit=Unit.POINTS)


def outperforms(name: str, first: Measurement | None, second: Measurement | None, comparisons: int) -> Check:
    """`first` is above `second` by its value, one of so many comparisons; or both are near 100 % and tie."""
    tie = first is not None and second is not None and min(first.estimate.value, second.estimate.value) >= NEAR_ALL
    low, wanted = (-ALIKE, f"> −{_plain(ALIKE)} points") if tie else (math.nextafter(0.0, 1.0), "> 0 points")
    compared = for_comparisons(difference(first, second), comparisons)
    return Check(name, f"{wanted}, by value", compared, low, by_value=True, unit=Unit.POINTS)


def mostly(name: str, measured: Measurement | None, share: float) -> Check:
    """By its value, the share of cases is at least `share`."""
    return Check(name, f"≥ {_plain(share)} % of them, by value", measured, share, by_value=True)


def more_reward(name: str, measured: Measurement | None, needs: str) -> Check:
    """The difference of rewards is greater than 0."""
    return Check(name, f"> 0 {Unit.REWARD}", measured, low=0.0, unit=Unit.REWARD, needs=needs)


def unmeasured(name: str, wanted: str, needs: str) -> Check:
    """A check of what no table of results holds, and what would measure it."""
    return Check(name, wanted, None, needs=needs)


def no_worse(name: str, measured: Measurement | None) -> Check:
    """The difference is greater than -ALIKE."""
    return Check(name, f"> −{_plain(ALIKE)} points", measured, low=-ALIKE, unit=Unit.POINTS)


def alike(name: str, measured: Measurement | None) -> Check:
    """The difference is between -ALIKE and ALIKE."""
    return Check(name, f"within ±{_plain(ALIKE)} points", measured, -ALIKE, ALIKE, unit=Unit.POINTS)


def _plain(share: float) -> str:
    return f"{100 * share:g}"


def signed(number: float, digits: int) -> str:
    """`+3.1` or `−3.1`."""
    return f"{number:+.{digits}f}".replace("-", "−")


def as_points(estimate: Estimate) -> str:
    """`+3.1 (+1.2 … +5.0) points`."""
    value, low, high = (signed(100 * number, 1) for number in estimate)
    return f"{value} ({low} … {high}) {Unit.POINTS}"


def _as_reward(estimate: Estimate) -> str:
    value, low, high = (signed(number, 3) for number in estimate)
    return f"{value} ({low} … {high}) {Unit.REWARD}"


_FORMATS = {Unit.PERCENT: as_percent, Unit.POINTS: as_points, Unit.REWARD: _as_reward}


def number_text(check: Check) -> str:
    """The measured value with its interval; without data `–`, or what would give them."""
    if check.measured is None:
        return check.needs or "–"
    return _FORMATS[check.unit](check.measured.estimate)


def with_verdict(checks: Sequence[Check], verdict: Verdict) -> list[Check]:
    """The checks with `verdict`."""
    return [check for check in checks if check.verdict is verdict]
