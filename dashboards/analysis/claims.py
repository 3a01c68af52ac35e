"""The dissertation's fifteen claims as code: each a list of checks on the pooled results of one preset.

Further statements of the text stand in `statements.py`.

Where the text leaves a choice, it is read as follows:

- A failure is every episode that does not end in the goal. Lost and captured are shares of all episodes.
- Claims about causes of failure (10, 15) are about means: over the five group counts for a number of robots, over the
  five robot counts for a number of groups.
- "Grows": the last value is above the first, and no step falls by more than 2 points. For all failures over the number
  of robots only the ends count, because the text itself says that they fall from 5 to 10 robots (claim 6).
- The claimed exceptions (7: below 80 % at 8 groups; 14: 15r×8g) are checks too.
- 1: 80 % is a limit for each setup, and the 85 % of Figure 3.4 (b) one for the mean of 10 to 25 robots.
- 4 is about "better", not about "equivalent": the text names these two setups as the better ones.
- 10: "most of the time" lost is the main reason: it is above captured in the mean of 1 to 4 groups.
- 12, "mostly by collision": of all failures in the 25 setups, more than half are collisions.
- 15: fewer captured than M_sensor from 10 robots on; with 5 robots neither method has any. "≤ 6 %" is about both.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from actors.evaluation.result_table import GROUPS, ROBOTS
from actors.evaluation.statistics import ratio
from dashboards.analysis.aggregate import (
    SETUPS,
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
)
from dashboards.analysis.claim_checks import (
    ABOUT_FAILURE,
    Check,
    Claim,
    about,
    alike,
    around_or_more,
    at_least,
    at_most,
    no_worse,
    none,
    outperforms,
    rises,
)
from dashboards.analysis.methods import method_label
from dashboards.analysis.quantities import fall, lost_less_captured, over_fixed, success_in
from dashboards.analysis.statements import FEWER_GROUPS, MOST_GROUPS, STATEMENTS, Checks, steady
from sim_core.outcomes import Outcome


def judge(results: Results) -> list[Claim]:
    """The claims and the further statements, in the order of their numbers, checked on the results of one preset."""
    everything = (*CLAIMS, *STATEMENTS)
    return [Claim(number, text, checks(results)) for number, (text, checks) in enumerate(everything, start=1)]


def _one_group(results: Results) -> list[Check]:
    few = about("5r×1g", success_in(results, "sensor", 5, 1), 1.0)
    many = [success_in(results, "sensor", n, 1) for n in ROBOTS[1:]]
    each = [at_least(f"{n}r×1g", rate, 0.8) for n, rate in zip(ROBOTS[1:], many, strict=True)]
    return [few, *each, about("10r to 25r×1g, mean", average(many), 0.85)]


def _few_robots(results: Results) -> list[Check]:
    return [
        about("5r×1g", success_in(results, "sensor", 5, 1), 1.0),
        about("5r×8g", success_in(results, "sensor", 5, 8), 0.5),
        rises("5r×1g less 5r×8g", fall(results, "sensor", Setup(5, 1), Setup(5, 8))),
    ]


def _smaller_fall(results: Results) -> list[Check]:
    falls = [fall(results, "sensor", Setup(n, 1), Setup(n, 8)) for n in (5, 10)]
    return [rises("fall with 5 robots less fall with 10", difference(*falls))]


def _first_transfers(results: Results) -> list[Check]:
    played = (Setup(10, 1), Setup(5, 2))
    return [rises(f"5r×1g in {setup} less Fixed", over_fixed(results, Setup(5, 1), setup)) for setup in played]


def _two_groups(results: Results) -> list[Check]:
    return [
        about("10r×2g", success_in(results, "sensor", 10, 2), 0.9),
        about("25r×2g", success_in(results, "sensor", 25, 2), 0.6),
        rises("10r×2g less 25r×2g", fall(results, "sensor", Setup(10, 2), Setup(25, 2))),
    ]


def _more_robots_help(results: Results) -> list[Check]:
    return [
        rises(f"10r×{groups}g less 5r×{groups}g", fall(results, "sensor", Setup(10, groups), Setup(5, groups)))
        for groups in (2, 3)
    ]


def _ten_robots(results: Results) -> list[Check]:
    every = [around_or_more(f"10r×{groups}g", success_in(results, "sensor", 10, groups), 0.8) for groups in GROUPS]
    two, eight = (success_in(results, "sensor", 10, groups) for groups in (2, 8))
    return [*every, about("10r×2g as printed", two, 0.9), at_most("10r×8g as printed", eight, 0.8)]


def _five_robots(results: Results) -> list[Check]:
    return [about(f"5r×{m}g", success_in(results, "sensor", 5, m), value) for m, value in ((2, 0.9), (8, 0.55))]


def _transfers(results: Results) -> list[Check]:
    pairs = [(Setup(10, 2), Setup(10, groups)) for groups in (3, 4, 8)]
    pairs += [(Setup(robots, 2), Setup(25, 2)) for robots in (5, 10)]
    return [
        rises(f"{trained} in {played} less Fixed", over_fixed(results, trained, played)) for trained, played in pairs
    ]


def _grows(name: str, values: Sequence[Measurement | None], labels: Sequence[str]) -> list[Check]:
    """Checks that the last value is above the first, and that no step falls by more than ALIKE."""
    steps = zip(pairwise(labels), pairwise(values), strict=True)
    ends = rises(f"{name} {labels[0]} → {labels[-1]}", difference(values[-1], values[0]))
    return [ends, *(no_worse(f"{name} {a} → {b}, a step", difference(late, early)) for (a, b), (early, late) in steps)]


def _failure_causes(results: Results) -> list[Check]:
    robots, groups = [f"{n}r" for n in ROBOTS], [f"{m}g" for m in GROUPS]
    failed = [over_groups(results, "sensor", n, PooledCell.failures) for n in ROBOTS]
    failed_by_groups = [over_robots(results, "sensor", m, PooledCell.failures) for m in GROUPS]
    taken = [over_groups(results, "sensor", n, captured) for n in ROBOTS]
    gone = dict(zip(ROBOTS, (over_groups(results, "sensor", n, lost) for n in ROBOTS), strict=True))
    return [
        rises(f"failures {robots[0]} → {robots[-1]}", difference(failed[-1], failed[0])),
        *_grows("failures", failed_by_groups, groups),
        *_grows("captured", taken, robots),
        rises("lost 5r less 10r", difference(gone[5], gone[10])),
        alike("lost 10r → 15r", difference(gone[15], gone[10])),
        *_grows("lost", [gone[n] for n in ROBOTS[2:]], robots[2:]),
        rises("lost less captured, 1g to 4g", lost_less_captured(results, "sensor", FEWER_GROUPS)),
        alike("lost less captured at 8g", lost_less_captured(results, "sensor", MOST_GROUPS)),
    ]


def _out_beats_all(results: Results) -> list[Check]:
    rivals = [(setup, rival) for setup in SETUPS for rival in ("sensor", "in")]
    return [
        outperforms(
            f"{setup} M_OUT less {method_label(rival)}",
            success_in(results, "out", *setup),
            success_in(results, rival, *setup),
            len(rivals),
        )._replace(setup=setup)
        for setup, rival in rivals
    ]


def _in_is_poor(results: Results) -> list[Check]:
    poor = [at_most(str(setup), success_in(results, "in", *setup), 0.5)._replace(setup=setup) for setup in SETUPS]
    return [*poor, at_least("collisions among failures", _collisions_among_failures(results), 0.5)]


def _collisions_among_failures(results: Results) -> Measurement | None:
    found = [results.fixed("in", setup) for setup in SETUPS]
    cells = [cell for cell in found if cell is not None]
    failed = sum(cell.episodes - cell.count(Outcome.GOAL) for cell in cells)
    if len(cells) < len(SETUPS) or failed == 0:
        return None
    seeds = [[(row.collision, row.episodes - row.goal) for row in cell.rows] for cell in cells]
    return Measurement(ratio(seeds), failed, max(len(cell.rows) for cell in cells))


def _out_decays(results: Results) -> list[Check]:
    near_all = [about(f"{n}r×1g", success_in(results, "out", n, 1), 1.0) for n in (5, 20, 25)]
    falls = {n: fall(results, "out", Setup(n, 1), Setup(n, 8)) for n in ROBOTS}
    smoother = average([falls[10], falls[15]])
    faster = [rises(f"fall at {n}r less fall at 10r and 15r", difference(falls[n], smoother)) for n in (5, 20, 25)]
    return [*near_all, *faster]


def _out_is_steady(results: Results) -> list[Check]:
    return steady(results, "out")


def _out_fails_less(results: Results) -> list[Check]:
    gone = {method: {n: over_groups(results, method, n, lost) for n in ROBOTS} for method in ("sensor", "out")}
    taken = {method: {n: over_groups(results, method, n, captured) for n in ROBOTS} for method in ("sensor", "out")}
    both = [(method, method_label(method)) for method in ("sensor", "out")]
    return [
        *(rises(f"{n}r lost, M_sensor less M_OUT", difference(gone["sensor"][n], gone["out"][n])) for n in ROBOTS),
        *(
            rises(f"{n}r captured, M_sensor less M_OUT", difference(taken["sensor"][n], taken["out"][n]))
            for n in ROBOTS[1:]
        ),
        *(none(f"5r captured, {name}", taken[method][5]) for method, name in both),
        *(at_most(f"{n}r captured, {name}", taken[method][n], 0.06) for method, name in both for n in ROBOTS[1:]),
        about("10r lost, M_sensor", gone["sensor"][10], 0.04, ABOUT_FAILURE),
        about("20r lost, M_sensor", gone["sensor"][20], 0.08, ABOUT_FAILURE),
        rises("lost 10r → 20r, M_sensor", difference(gone["sensor"][20], gone["sensor"][10])),
        alike("lost 10r → 20r, M_OUT", difference(gone["out"][20], gone["out"][10])),
    ]


CLAIMS: tuple[tuple[str, Checks], ...] = (
    ("M_sensor Fixed, 1 group: 5 robots ≈ 100 %; up to 25 robots still > 80 %, around 85 %", _one_group),
    ("M_sensor Fixed, 5 robots: ≈ 100 % with 1 group falls to ≈ 50 % with 8", _few_robots),
    ("M_sensor Fixed, 10 robots: the fall from 1 to 8 groups is smaller than with 5 robots", _smaller_fall),
    (
        "M_sensor, 5r×1g policy tested on 10r×1g and 5r×2g: better than the Fixed policy there",
        _first_transfers,
    ),
    ("M_sensor Fixed, 2 groups: 90 % with 10 robots falls to ≈ 60 % with 25", _two_groups),
    ("M_sensor Fixed: going from 5 to 10 robots raises success (2 and 3 groups)", _more_robots_help),
    (
        "M_sensor Fixed, 10 robots: around 80 % or more for every group count; 90 % at 2 groups, < 80 % at 8",
        _ten_robots,
    ),
    ("M_sensor Fixed, 5 robots: 90 % at 2 groups, 55 % at 8", _five_robots),
    (
        "M_sensor: 10r×2g policy beats the Fixed one on 10r×3g, 10r×4g and 10r×8g; 5r×2g and 10r×2g policies beat "
        "Fixed on 25r×2g",
        _transfers,
    ),
    (
        "M_sensor: failures grow with robots and with groups; captured grows with robots; lost falls 5→10, flat 10→15, "
        "grows 15→25; lost is above captured, at 8 groups level with it",
        _failure_causes,
    ),
    ("M_OUT beats M_sensor and M_IN in all 25 setups", _out_beats_all),
    ("M_IN stays under 50 % in all 25 setups, mostly by collision", _in_is_poor),
    (
        "M_OUT with 1 group ≈ 100 % for 5, 20, 25 robots, and decays fast with groups, faster than with 10 and 15",
        _out_decays,
    ),
    ("M_OUT ≥ 80 % for 10 and 15 robots at every group count, except 15r×8g", _out_is_steady),
    (
        "M_OUT fails less by lost and by captured than M_sensor at every robot count; captured ≤ 6 %, none with 5 "
        "robots; M_sensor's lost goes 4 % → 8 % from 10 to 20 robots while M_OUT's stays flat",
        _out_fails_less,
    ),
)
