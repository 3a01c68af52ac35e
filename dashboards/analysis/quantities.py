"""Quantities that several claims are about: success of a setup, falls of it, Extrapolation less Fixed."""

from __future__ import annotations

from collections.abc import Sequence

from actors.evaluation.statistics import Estimate
from dashboards.analysis.aggregate import (
    Measurement,
    PooledCell,
    Results,
    Setup,
    average,
    difference,
    measured,
    success,
)


def success_in(results: Results, method: str, robots: int, groups: int) -> Measurement | None:
    """Fixed success in a setup."""
    return measured(results.fixed(method, Setup(robots, groups)), success)


def fall(results: Results, method: str, first: Setup, last: Setup) -> Measurement | None:
    """Fixed success in `first` minus that in `last`."""
    return difference(success_in(results, method, *first), success_in(results, method, *last))


def over_fixed(results: Results, trained: Setup, played: Setup) -> Measurement | None:
    """M_sensor's success of the policy trained in `trained` minus that of the Fixed policy, both tested in `played`."""
    foreign = measured(results.transferred("sensor", trained, played), success)
    return difference(foreign, success_in(results, "sensor", *played))


def lost_less_captured(results: Results, method: str, setups: Sequence[Setup]) -> Measurement | None:
    """Share of lost episodes minus share of captured ones, averaged over Fixed setups."""
    return average([measured(results.fixed(method, setup), PooledCell.lost_minus_captured) for setup in setups])


def share_above_zero(differences: Sequence[Measurement | None]) -> Measurement | None:
    """The share of differences that are above 0; None if one is missing.

    It lies between the share of those whose whole interval is above 0 and the share of those whose interval reaches
    above 0.
    """
    known = [each for each in differences if each is not None]
    if len(known) < len(differences):
        return None
    value, low, high = (
        sum(numbers > 0 for numbers in column) / len(known)
        for column in zip(*(each.estimate for each in known), strict=True)
    )
    return Measurement(
        Estimate(value, low, high), sum(each.episodes for each in known), max(each.seeds for each in known)
    )
