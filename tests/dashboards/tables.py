"""A synthetic table of results that agrees with all fifteen claims; tests change single cells of it."""

from __future__ import annotations

from collections.abc import Iterable

from actors.evaluation.result_table import LEARNED, ResultRow
from dashboards.analysis.aggregate import GROUPS, ROBOTS, SETUPS, Setup

EPISODES = 3000
SENSOR_SUCCESS = {  # by groups 1, 2, 3, 4, 8
    5: (94, 84, 78, 72, 52),
    10: (94, 92, 88, 84, 76),
    15: (93, 86, 80, 76, 68),
    20: (92, 80, 76, 70, 62),
    25: (90, 66, 62, 58, 52),
}
SENSOR_LOST = {
    5: (6, 12, 16, 18, 16),
    10: (4, 5, 5, 5, 6),
    15: (4, 5, 5, 5, 6),
    20: (7, 8, 8, 8, 9),
    25: (9, 12, 12, 12, 15),
}
SENSOR_CAPTURED = {
    5: (0, 0, 0, 0, 0),
    10: (0, 0, 0, 1, 8),
    15: (0, 1, 1, 3, 13),
    20: (0, 1, 1, 3, 13),
    25: (0,) * 4 + (18,),
}
OUT_SUCCESS = {
    5: (99, 93, 90, 85, 70),
    10: (98, 97, 95, 92, 88),
    15: (98, 95, 92, 88, 76),
    20: (98, 88, 85, 80, 70),
    25: (98, 80, 78, 74, 66),
}
OUT_LOST = {5: (1, 5, 6, 8, 12), 10: (1, 1, 2, 2, 3), 15: (1, 1, 2, 2, 3), 20: (1, 2, 2, 2, 3), 25: (1, 5, 5, 5, 6)}
OUT_CAPTURED = {5: (0,) * 5, 10: (0, 0, 0, 0, 1), 15: (0, 0, 0, 1, 1), 20: (0, 0, 0, 1, 5), 25: (0, 0, 0, 1, 9)}
IN_SUCCESS = 30.0
TRANSFERS = {
    (Setup(5, 1), Setup(10, 1)): 95,
    (Setup(5, 1), Setup(5, 2)): 85,
    (Setup(10, 2), Setup(10, 3)): 92,
    (Setup(10, 2), Setup(10, 4)): 89,
    (Setup(10, 2), Setup(10, 8)): 81,
    (Setup(5, 2), Setup(25, 2)): 72,
    (Setup(10, 2), Setup(25, 2)): 75,
}


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


def _key(line: ResultRow) -> tuple[object, ...]:
    return line[:8]
