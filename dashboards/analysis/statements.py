"""Further statements of the text, numbered after the fifteen claims, and what contradicts what.

Where the text leaves a choice, it is read as follows:

- 16: at most 0.5 % of the episodes with one group fail in any way but lost, for each number of robots.
- 19: the situations are the Extrapolation bars of Figures 3.5 and 3.6.
- 22: lost and captured are shares of all episodes, averaged over the five group counts.
- 24: in every setup in which M_OUT was trained without the field, since the text names no exception.
- 25: "most of the time": in more than half of the 20 setups with 1 to 4 groups.
- 26: DQN overestimates, and more than Double DQN: values are above returns, as of `overestimation.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from actors.evaluation.result_table import DRAWN_TRAININGS, GROUPS, ROBOTS, is_drawn
from dashboards.analysis.aggregate import (
    SETUPS,
    PooledCell,
    Results,
    Setup,
    captured,
    difference,
    lost,
    measured,
    over_groups,
    success,
)
from dashboards.analysis.claim_checks import (
    ALMOST_EVERY,
    CLOSE_TO_ZERO,
    NOT_VANISHED,
    Check,
    about,
    alike,
    at_least,
    at_most,
    more_reward,
    mostly,
    none,
    rises,
    unmeasured,
)
from dashboards.analysis.overestimation import overestimation
from dashboards.analysis.quantities import fall, lost_less_captured, over_fixed, share_above_zero, success_in

FEWER_GROUPS = tuple(setup for setup in SETUPS if setup.groups < GROUPS[-1])
MOST_GROUPS = tuple(setup for setup in SETUPS if setup.groups == GROUPS[-1])
NO_FIELD = "apf_gain_m4_s=0.0"
"""What `shoal sweep --set` needs to take u_apf away."""
SEVERAL_GROUPS_DRAWN = tuple(
    (Setup(*trained), played)
    for trained in DRAWN_TRAININGS
    for played in SETUPS
    if trained[1] > 1 and is_drawn(trained, played)
)
"""Trained and played setups of the Extrapolation bars in Figures 3.5 and 3.6."""


def steady(results: Results, method: str) -> list[Check]:
    """Checks that a method stays above 80 % with 10 and 15 robots, but for the exception that the text names."""
    exception = Setup(15, 8)
    good = [Setup(robots, groups) for robots in (10, 15) for groups in GROUPS if (robots, groups) != exception]
    checks = [at_least(str(setup), success_in(results, method, *setup), 0.8) for setup in good]
    return [*checks, at_most(f"{exception}, the exception", success_in(results, method, *exception), 0.8)]


def _only_lost(results: Results) -> list[Check]:
    cells = {n: results.fixed("sensor", Setup(n, 1)) for n in ROBOTS}
    return [none(f"{n}r×1g, others", measured(cells[n], PooledCell.failures_but_lost)) for n in ROBOTS]


def _around_85(results: Results) -> list[Check]:
    return [about(f"{n}r×1g", success_in(results, "sensor", n, 1), 0.85) for n in ROBOTS[1:]]


def _three_groups(results: Results) -> list[Check]:
    played = (Setup(10, 4), Setup(10, 8))
    better = [rises(f"10r×3g in {setup} less Fixed", over_fixed(results, Setup(10, 3), setup)) for setup in played]
    return [*better, rises("15r×3g less 10r×3g", fall(results, "sensor", Setup(15, 3), Setup(10, 3)))]


def _almost_every(results: Results) -> list[Check]:
    differences = [over_fixed(results, trained, played) for trained, played in SEVERAL_GROUPS_DRAWN]
    share = share_above_zero(differences)
    return [mostly(f"better than Fixed, of {len(differences)} situations", share, ALMOST_EVERY)]


def _five_are_worse(results: Results) -> list[Check]:
    return [
        rises(f"10r×{m}g less 5r×{m}g", fall(results, "sensor", Setup(10, m), Setup(5, m))) for m in GROUPS if m > 1
    ]


def _sensor_is_steady(results: Results) -> list[Check]:
    return steady(results, "sensor")


def _how_out_fails(results: Results) -> list[Check]:
    less = {n: lost_less_captured(results, "out", [Setup(n, m) for m in GROUPS]) for n in ROBOTS}
    taken = {n: over_groups(results, "out", n, captured) for n in ROBOTS}
    more = {n: difference(taken[n], over_groups(results, "out", n, lost)) for n in (20, 25)}
    return [
        rises("5r lost less captured", less[5]),
        *(rises(f"{n}r captured less lost", more[n]) for n in (20, 25)),
        alike("captured 10r → 15r", difference(taken[15], taken[10])),
    ]


def _does_not_vanish(results: Results) -> list[Check]:
    played = [Setup(20, groups) for robots, groups in DRAWN_TRAININGS if robots == 5]
    cells = {setup: results.transferred("sensor", Setup(5, setup.groups), setup) for setup in played}
    return [
        at_least(f"5r×{setup.groups}g in {setup}", measured(cell, success), NOT_VANISHED)
        for setup, cell in cells.items()
    ]


def _without_field(results: Results) -> list[Check]:
    without = results.variants.get(NO_FIELD, Results([]))
    setups = without.fixed_present("out")
    if not setups:
        needs = f"needs the table of `shoal sweep --methods out --set {NO_FIELD}` beside it, as `variants.csv`"
        return [unmeasured("M_OUT without u_apf", "≤ 10 %", needs)]
    return [
        at_most(str(setup), success_in(without, "out", *setup), CLOSE_TO_ZERO)._replace(setup=setup) for setup in setups
    ]


def _overestimation(results: Results) -> list[Check]:
    needs = "needs the table of `make overestimation` beside it, as `values.csv`"
    dqn, double_dqn = (overestimation(results.values, algorithm) for algorithm in ("dqn", "double_dqn"))
    return [
        more_reward("values less returns, DQN", dqn, needs),
        more_reward("values less returns, DQN less Double DQN", difference(dqn, double_dqn), needs),
    ]


def _lost_most_of_the_time(results: Results) -> list[Check]:
    share = share_above_zero([lost_less_captured(results, "sensor", [setup]) for setup in FEWER_GROUPS])
    return [
        mostly(f"lost above captured, of {len(FEWER_GROUPS)} setups", share, 0.5),
        alike("lost less captured at 8g", lost_less_captured(results, "sensor", MOST_GROUPS)),
    ]


Checks = Callable[[Results], list[Check]]

STATEMENTS: tuple[tuple[str, Checks], ...] = (
    ("M_sensor, 1 group: the only failure is lost", _only_lost),
    ("M_sensor Fixed, 1 group: around 85 % with 10 to 25 robots (Figure 3.4 b)", _around_85),
    (
        "M_sensor: 10r×3g policy beats the Fixed one on 10r×4g and 10r×8g; 10 robots are below 15 at 3 groups",
        _three_groups,
    ),
    ("M_sensor: Extrapolation is better than Fixed in almost every situation of Figures 3.5 and 3.6", _almost_every),
    ("M_sensor Fixed: 5 robots do worse than 10 at every group count from 2 on", _five_are_worse),
    ("M_sensor ≥ 80 % for 10 and 15 robots at every group count, except 15r×8g", _sensor_is_steady),
    (
        "M_OUT fails with 5 robots by lost, with 20 and 25 rather by captured; captured is flat from 10 to 15",
        _how_out_fails,
    ),
    ("M_sensor: 5-robot policies tested on 20 robots do not vanish", _does_not_vanish),
    ("Without u_apf M_OUT's success would be close to zero", _without_field),
    (
        "M_sensor: most of the time lost is the main reason of failure; at 8 groups it is level with captured",
        _lost_most_of_the_time,
    ),
    ("Double DQN overestimates less than DQN (Chapter 2)", _overestimation),
)


class Contradiction(NamedTuple):
    """Numbers of claims of which no world can have all, and why."""

    numbers: tuple[int, ...]
    why: str


CONTRADICTIONS = (
    Contradiction(
        (5, 10, 15),
        "25r×2g fails in 40 % (5), but in the figures of 10 and 15 lost and captured together stay near 18 %, and "
        "M_sensor hardly fails otherwise",
    ),
    Contradiction((6, 10), "failures grow with robots (10) and fall from 5 to 10 robots (6); 10 is judged by 5 and 25"),
    Contradiction((7, 21), "10r×8g is below 80 % (7) and above 80 % (21)"),
    Contradiction(
        (1, 11, 13),
        "in 5r×1g both methods are near 100 % (1, 13), and one is above the other (11), where a tie counts",
    ),
    Contradiction(
        (12, 13, 14),
        "no contradiction in words: in every world tried, what keeps M_IN under 50 % (12) lowers M_OUT, too",
    ),
)
