"""A synthetic table of results that agrees with the fifteen claims, and with statements that contradict none of them.

Tests change single cells of it.
"""

from __future__ import annotations

from collections.abc import Iterable

from actors.evaluation.result_table import LEARNED, ResultRow
from dashboards.analysis.aggregate import GROUPS, ROBOTS, SETUPS, Results, Setup
from dashboards.analysis.statements import NO_FIELD, SEVERAL_GROUPS_DRAWN

EPISODES = 3000
SENSOR_SUCCESS = {  # by groups 1, 2, 3, 4, 8
    5: (94, 84, 78, 72, 52),
    10: (94, 92, 88, 84, 76),
    15: (93, 86, 91, 82, 68),
    20: (92, 80, 76, 70, 62),
    25: (90, 66, 62, 58, 52),
}
SENSOR_LOST = {
    5: (6, 12, 16, 18, 16),
    10: (6, 5, 5, 5, 6),
    15: (7, 5, 5, 5, 6),
    20: (8, 8, 8, 8, 9),
    25: (10, 12, 12, 12, 15),
}
SENSOR_CAPTURED = {
    5: (0, 0, 0, 0, 0),
    10: (0, 0, 0, 1, 8),
    15: (0, 1, 1, 3, 13),
    20: (0, 2, 2, 4, 13),
    25: (0, 2, 3, 4, 18),
}
OUT_SUCCESS = {
    5: (99, 93, 90, 85, 70),
    10: (98, 97, 95, 92, 88),
    15: (98, 95, 92, 88, 76),
    20: (98, 88, 85, 80, 70),
    25: (98, 80, 78, 74, 66),
}
OUT_LOST = {5: (1, 5, 6, 8, 12), 10: (1, 1, 2, 2, 3), 15: (1, 1, 2, 2, 3), 20: (1, 2, 2, 2, 3), 25: (1, 2, 2, 2, 6)}
OUT_CAPTURED = {5: (0,) * 5, 10: (0, 0, 0, 0, 1), 15: (0, 0, 0, 1, 1), 20: (0, 1, 2, 3, 9), 25: (0, 2, 3, 4, 12)}
IN_SUCCESS = 30.0
TRANSFERS = {
    (Setup(5, 1), Setup(10, 1)): 97,
    (Setup(5, 1), Setup(5, 2)): 88,
    (Setup(10, 2), Setup(10, 3)): 92,
    (Setup(10, 2), Setup(10, 4)): 89,
    (Setup(10, 2), Setup(10, 8)): 81,
    (Setup(5, 2), Setup(25, 2)): 72,
    (Setup(10, 2), Setup(25, 2)): 75,
}
OVER_FIXED = 4
"""Points by which the other Extrapolation bars of Figures 3.5 and 3.6 are above Fixed."""


def row(
    method: str,
    played: Setup,
    *,
    success: float,
    lost: float = 0.0,
    captured: float = 0.0,
    collision: float = 0.0,
    trained: Setup | None = None,
    seed: int = 0,
    preset: str = "thesis",
    episodes: int = EPISODES,
) -> ResultRow:
    """A row from percentages; the rest are timeouts."""
    counts = [round(share * episodes / 100) for share in (success, lost, captured, collision)]
    home = trained or played
    timeout = episodes - sum(counts)
    return ResultRow(preset, LEARNED, method, *home, seed, *played, episodes, *counts, timeout, 210.0, "c0ffee")


def fixed(method: str, played: Setup, **changes: float) -> ResultRow:
    """A Fixed row of the synthetic table, with some percentages changed."""
    place = GROUPS.index(played.groups)
    if method == "in":
        shares = {"success": IN_SUCCESS, "lost": 10.0, "captured": 4.0, "collision": 50.0}
    else:
        tables = (
            (SENSOR_SUCCESS, SENSOR_LOST, SENSOR_CAPTURED)
            if method == "sensor"
            else (OUT_SUCCESS, OUT_LOST, OUT_CAPTURED)
        )
        shares = dict(
            zip(("success", "lost", "captured"), (float(t[played.robots][place]) for t in tables), strict=True)
        )
    return row(method, played, **(shares | changes))


def claimed_table(*changed: ResultRow, without: Iterable[ResultRow] = ()) -> list[ResultRow]:
    """The table without some rows, and with rows replaced by those of the same policy and setup in `changed`."""
    rows = [fixed(method, setup) for method in ("sensor", "in", "out") for setup in SETUPS]
    rows += [_above_fixed(trained, played) for trained, played in SEVERAL_GROUPS_DRAWN]
    rows += [row("sensor", played, success=share, trained=trained) for (trained, played), share in TRANSFERS.items()]
    rows += [
        row("sensor", Setup(robots, 1), success=80.0, trained=Setup(5, 1)) for robots in ROBOTS if robots > 10
    ]  # drawn in figures, but in no claim
    table = {_key(line): line for line in rows}
    for line in changed:
        table[_key(line)] = line
    for line in without:
        del table[_key(line)]
    return list(table.values())


def _above_fixed(trained: Setup, played: Setup) -> ResultRow:
    share = SENSOR_SUCCESS[played.robots][GROUPS.index(played.groups)]
    return row("sensor", played, success=share + OVER_FIXED, trained=trained)


def claimed(*changed: ResultRow, without: Iterable[ResultRow] = ()) -> Results:
    """The results of `claimed_table`, with a variant without u_apf."""
    no_field = Results([row("out", Setup(10, 2), success=3, collision=90)])
    return Results(claimed_table(*changed, without=without), {NO_FIELD: no_field})


def _key(line: ResultRow) -> tuple[object, ...]:
    return line[:8]
