"""The fifteen claims, on a table that agrees with all of them, and on tables in which one cell disagrees."""

from __future__ import annotations

import pytest

from actors.evaluation.result_table import ResultRow
from dashboards.analysis.aggregate import SETUPS, Results, Setup
from dashboards.analysis.claim_checks import Claim, Verdict
from dashboards.analysis.claims import CLAIMS, judge
from tests.dashboards.tables import claimed_table, fixed, row

HOLDS, FAILS, UNDECIDED, NO_DATA = Verdict.HOLDS, Verdict.FAILS, Verdict.UNDECIDED, Verdict.NO_DATA


def sensor(robots: int, groups: int, **changes: float) -> ResultRow:
    return fixed("sensor", Setup(robots, groups), **changes)


def out(robots: int, groups: int, **changes: float) -> ResultRow:
    return fixed("out", Setup(robots, groups), **changes)


def moved(trained: Setup, played: Setup, success: float) -> ResultRow:
    return row("sensor", played, success=success, trained=trained)


def verdicts(*changed: ResultRow) -> dict[int, Verdict]:
    return {claim.number: claim.verdict for claim in judge(Results(claimed_table(*changed)))}


def claim(number: int, rows: list[ResultRow]) -> Claim:
    return judge(Results(rows))[number - 1]


def failing(number: int, *changed: ResultRow) -> list[str]:
    """Names of a claim's checks that do not hold."""
    return [check.name for check in claim(number, claimed_table(*changed)).checks if check.verdict is FAILS]


def test_there_are_fifteen_claims_and_the_synthetic_table_agrees_with_all():
    assert len(CLAIMS) == 15
    assert verdicts() == dict.fromkeys(range(1, 16), HOLDS)


REFUTING = [
    (1, sensor(5, 1, success=80), "5r×1g"),
    (1, sensor(25, 1, success=75), "25r×1g"),
    (2, sensor(5, 8, success=75), "5r×8g"),
    (3, sensor(10, 8, success=40), "fall with 5 robots less fall with 10"),
    (4, moved(Setup(5, 1), Setup(10, 1), 88), "5r×1g in 10r×1g less Fixed"),
    (4, moved(Setup(5, 1), Setup(5, 2), 75), "5r×1g in 5r×2g less Fixed"),
    (5, sensor(10, 2, success=70), "10r×2g"),
    (5, sensor(25, 2, success=80), "25r×2g"),
    (6, sensor(5, 2, success=96), "10r×2g less 5r×2g"),
    (6, sensor(5, 3, success=93), "10r×3g less 5r×3g"),
    (7, sensor(10, 4, success=60), "10r×4g"),
    (7, sensor(10, 8, success=85), "10r×8g as printed"),
    (7, sensor(10, 2, success=75), "10r×2g as printed"),
    (8, sensor(5, 2, success=70), "5r×2g"),
    (8, sensor(5, 8, success=35), "5r×8g"),
    (9, moved(Setup(10, 2), Setup(10, 3), 80), "10r×2g in 10r×3g less Fixed"),
    (9, moved(Setup(10, 2), Setup(10, 4), 80), "10r×2g in 10r×4g less Fixed"),
    (9, moved(Setup(10, 2), Setup(10, 8), 70), "10r×2g in 10r×8g less Fixed"),
    (9, moved(Setup(5, 2), Setup(25, 2), 60), "5r×2g in 25r×2g less Fixed"),
    (9, moved(Setup(10, 2), Setup(25, 2), 60), "10r×2g in 25r×2g less Fixed"),
    (10, sensor(15, 4, success=40, lost=50, captured=3), "lost 15r → 25r"),
    (10, sensor(15, 8, success=55, lost=6, captured=35), "captured 15r → 20r, a step"),
    (10, sensor(15, 4, success=60, lost=30, captured=3), "lost 10r → 15r"),
    (10, sensor(10, 8, success=20, lost=60, captured=8), "lost 5r less 10r"),
    (10, sensor(25, 8, success=60, lost=36, captured=0), "lost less captured at 8g"),
    (10, sensor(5, 1, success=5, lost=6), "failures 5r → 25r"),
    (11, out(20, 3, success=50), "20r×3g M_OUT less M_sensor"),
    (11, fixed("in", Setup(25, 8), success=75), "25r×8g M_OUT less M_IN"),
    (12, fixed("in", Setup(10, 1), success=60), "10r×1g"),
    (13, out(25, 1, success=85), "25r×1g"),
    (13, out(20, 8, success=90), "20r×1g less 20r×8g"),
    (14, out(10, 3, success=70), "10r×3g"),
    (14, out(15, 8, success=90), "15r×8g, the exception"),
    (15, out(20, 8, success=60, lost=35), "lost 10r → 20r, M_OUT"),
    (15, out(5, 8, success=30, lost=60), "5r lost, M_sensor less M_OUT"),
    (15, out(15, 8, success=70, captured=20), "15r captured, M_sensor less M_OUT"),
    (15, out(5, 4, success=80, captured=8), "5r captured, M_OUT"),
    (15, sensor(25, 8, success=45, lost=15, captured=38), "25r captured, M_sensor"),
    (15, sensor(10, 8, success=70, lost=22, captured=8), "10r lost, M_sensor"),
    (15, sensor(20, 8, success=50, lost=30, captured=13), "20r lost, M_sensor"),
]


@pytest.mark.parametrize(
    ("number", "changed", "name"), REFUTING, ids=lambda value: getattr(value, "method", str(value))
)
def test_one_cell_refutes_the_claim(number: int, changed: ResultRow, name: str):
    assert name in failing(number, changed)
    assert verdicts(changed)[number] is FAILS


def test_every_claim_can_be_refuted():
    assert {number for number, _, _ in REFUTING} == set(range(1, 16))


@pytest.mark.parametrize(
    ("changed", "refuted"),
    [
        (sensor(25, 1, success=75), {1}),
        (moved(Setup(10, 2), Setup(10, 3), 80), {9}),
        (fixed("in", Setup(10, 1), success=60), {12}),
        (out(15, 8, success=90), {14}),
        (moved(Setup(5, 1), Setup(15, 1), 10), set()),
        (row("out", Setup(10, 3), success=1, trained=Setup(5, 1)), set()),
        (sensor(15, 4, success=70), set()),
    ],
)
def test_a_cell_refutes_only_claims_about_it(changed: ResultRow, refuted: set[int]):
    assert {number for number, verdict in verdicts(changed).items() if verdict is not HOLDS} == refuted


def test_mostly_by_collision_is_a_share_of_all_failures():
    lost_instead = [fixed("in", setup, success=30, lost=40, collision=20) for setup in SETUPS]
    assert failing(12, *lost_instead) == ["collisions among failures"]
    assert verdicts(*lost_instead[:3])[12] is HOLDS


def test_few_episodes_leave_a_claim_undecided():
    few = [line._replace(episodes=20, goal=line.goal // 150, lost=20 - line.goal // 150) for line in claimed_table()]
    few = [line._replace(captured=0, collision=0, timeout=0) for line in few]
    assert claim(1, few).verdict is UNDECIDED


@pytest.mark.parametrize("number", range(1, 16))
def test_an_empty_table_decides_nothing(number: int):
    found = claim(number, [])
    assert found.verdict is NO_DATA
    assert {check.verdict for check in found.checks} == {NO_DATA}


def test_a_missing_cell_is_no_data_only_where_it_is_needed():
    rows = claimed_table(without=[sensor(25, 2)])
    missing = {found.number for found in judge(Results(rows)) if found.verdict is NO_DATA}
    assert missing == {5, 9, 10, 11, 15}


def test_a_refuted_claim_needs_no_more_data():
    rows = claimed_table(sensor(25, 1, success=75), without=[sensor(20, 1)])
    assert claim(1, rows).verdict is FAILS


def test_names_of_checks_are_unique_in_a_claim():
    for found in judge(Results(claimed_table())):
        names = [check.name for check in found.checks]
        assert len(set(names)) == len(names), found.number


def test_claims_over_all_setups_have_a_check_for_each():
    claims = judge(Results(claimed_table()))
    for number, times in ((11, 2), (12, 1)):
        setups = [check.setup for check in claims[number - 1].checks if check.setup is not None]
        assert sorted(setups) == sorted(SETUPS * times)
