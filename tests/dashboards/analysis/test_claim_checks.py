"""Verdicts of single checks and of claims, by hand."""

from __future__ import annotations

import pytest

from actors.evaluation.statistics import Estimate
from dashboards.analysis.aggregate import Measurement
from dashboards.analysis.claim_checks import (
    Check,
    Claim,
    Verdict,
    about,
    alike,
    around_or_more,
    at_least,
    at_most,
    no_worse,
    none,
    number_text,
    rises,
)

HOLDS, FAILS, UNDECIDED, NO_DATA = Verdict.HOLDS, Verdict.FAILS, Verdict.UNDECIDED, Verdict.NO_DATA


def measured(value: float, low: float, high: float) -> Measurement:
    return Measurement(Estimate(value, low, high), 100)


@pytest.mark.parametrize(
    ("interval", "verdict"),
    [
        ((0.85, 0.81, 0.89), HOLDS),
        ((0.81, 0.79, 0.83), UNDECIDED),
        ((0.79, 0.77, 0.81), UNDECIDED),
        ((0.75, 0.71, 0.79), FAILS),
        ((0.90, 0.80, 0.95), HOLDS),
    ],
)
def test_a_limit_is_judged_by_the_whole_interval(interval: tuple[float, float, float], verdict: Verdict):
    assert at_least("x", measured(*interval), 0.8).verdict is verdict
    value, low, high = interval
    mirrored = measured(1 - value, 1 - high, 1 - low)
    assert at_most("x", mirrored, 1 - 0.8).verdict is verdict


@pytest.mark.parametrize(
    ("interval", "verdict"),
    [
        ((0.60, 0.50, 0.70), HOLDS),
        ((0.70, 0.66, 0.74), HOLDS),
        ((0.72, 0.69, 0.75), UNDECIDED),
        ((0.73, 0.705, 0.76), FAILS),
        ((0.48, 0.46, 0.51), UNDECIDED),
        ((0.45, 0.41, 0.49), FAILS),
    ],
)
def test_about_is_met_by_the_value_within_ten_points(interval: tuple[float, float, float], verdict: Verdict):
    assert about("x", measured(*interval), 0.6).verdict is verdict


def test_about_a_failure_rate_is_within_two_points():
    assert about("x", measured(0.06, 0.055, 0.065), 0.04, 0.02).verdict is HOLDS
    assert about("x", measured(0.08, 0.075, 0.085), 0.04, 0.02).verdict is FAILS


@pytest.mark.parametrize(
    ("interval", "verdict"),
    [
        ((0.0, 0.0, 0.02), HOLDS),
        ((0.005, 0.0, 0.02), HOLDS),
        ((0.006, 0.0, 0.02), UNDECIDED),
        ((0.02, 0.01, 0.03), FAILS),
    ],
)
def test_none_is_met_by_the_value_up_to_half_a_percent(interval: tuple[float, float, float], verdict: Verdict):
    assert none("x", measured(*interval)).verdict is verdict


def test_about_all_and_around_or_more_have_no_upper_limit():
    assert about("x", measured(1.0, 0.99, 1.0), 1.0).verdict is HOLDS
    assert around_or_more("x", measured(0.99, 0.98, 1.0), 0.8).verdict is HOLDS
    assert around_or_more("x", measured(0.71, 0.68, 0.74), 0.8).verdict is HOLDS
    assert around_or_more("x", measured(0.60, 0.57, 0.63), 0.8).verdict is FAILS


@pytest.mark.parametrize(
    ("interval", "rise", "kept", "same"),
    [
        ((0.05, 0.03, 0.07), HOLDS, HOLDS, FAILS),
        ((0.01, 0.005, 0.015), HOLDS, HOLDS, HOLDS),
        ((0.00, -0.01, 0.01), UNDECIDED, HOLDS, HOLDS),
        ((-0.01, -0.03, 0.01), UNDECIDED, UNDECIDED, UNDECIDED),
        ((-0.05, -0.07, -0.03), FAILS, FAILS, FAILS),
    ],
)
def test_differences(interval: tuple[float, float, float], rise: Verdict, kept: Verdict, same: Verdict):
    found = measured(*interval)
    assert (rises("x", found).verdict, no_worse("x", found).verdict, alike("x", found).verdict) == (rise, kept, same)


def test_without_data_there_is_no_verdict():
    checks = [about("x", None, 0.5), at_least("x", None, 0.5), rises("x", None), alike("x", None)]
    assert {check.verdict for check in checks} == {NO_DATA}
    assert {number_text(check) for check in checks} == {"–"}


@pytest.mark.parametrize(
    ("verdicts", "whole"),
    [
        ([HOLDS, HOLDS], HOLDS),
        ([HOLDS, UNDECIDED], UNDECIDED),
        ([UNDECIDED, NO_DATA], NO_DATA),
        ([HOLDS, NO_DATA, FAILS, UNDECIDED], FAILS),
    ],
)
def test_a_claim_is_as_good_as_its_worst_check(verdicts: list[Verdict], whole: Verdict):
    at = {HOLDS: (0.6, 0.55, 0.65), UNDECIDED: (0.5, 0.4, 0.6), FAILS: (0.2, 0.1, 0.3)}
    checks = [at_least("x", measured(*at[verdict]) if verdict in at else None, 0.5) for verdict in verdicts]
    assert [check.verdict for check in checks] == verdicts
    assert Claim(1, "text", checks).verdict is whole


def test_numbers_are_percent_or_signed_points():
    assert number_text(at_least("x", measured(0.898, 0.878, 0.915), 0.8)) == "89.8 % (87.8 … 91.5)"
    assert number_text(rises("x", measured(0.031, -0.012, 0.05))) == "+3.1 (−1.2 … +5.0) points"


def test_wanted_names_the_range():
    none = None
    checks: list[Check] = [about("x", none, 0.55), about("x", none, 1.0), at_most("x", none, 0.005), rises("x", none)]
    assert [check.wanted for check in checks] == ["≈ 55 % (45 … 65 %)", "≈ 100 % (90 … 100 %)", "≤ 0.5 %", "> 0 points"]
