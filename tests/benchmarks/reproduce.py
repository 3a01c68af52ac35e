"""`make reproduce`: trains some cells of the committed results anew, and says whether they land where those are."""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import get_args

import numpy as np
from rich.console import Console
from rich.table import Table

import dashboards
from actors.estimates import as_percent
from actors.result_table import LEARNED, ResultRow, read_table
from dashboards.pooled import Measured, Results, Setup, success
from deploy.cli import main as shoal
from learner.presets import PresetName
from sim_core.outcomes import ENDED

RESULTS = Path(dashboards.__file__).parent / "results"


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.reproduce", description=__doc__)
    parser.add_argument("--preset", choices=get_args(PresetName), default="thesis", help="whose results")
    parser.add_argument("--cells", type=int, default=3, help="so many of them, drawn at random")
    parser.add_argument("--seed", type=int, default=0, help="of the draw")
    return parser.parse_args(arguments)


def drawn(rows: list[ResultRow], cells: int, seed: int) -> list[ResultRow]:
    """So many trained policies of a table, each by its Fixed row."""
    fixed = [row for row in rows if row.policy == LEARNED and row.is_fixed]
    return [fixed[i] for i in np.random.default_rng(seed).choice(len(fixed), cells, replace=False)]


def trained_anew(row: ResultRow, folder: Path) -> ResultRow:
    """The same cell's Fixed row by a sweep of its own."""
    setup = [
        "--methods",
        row.method,
        "--robots",
        str(row.robots),
        "--groups",
        str(row.groups),
        "--seeds",
        str(row.seed),
    ]
    whole = ["--preset", row.preset, "--extrapolation", "none", "--baselines", "--runs-dir", str(folder), "--name", "s"]
    assert shoal(["sweep", *setup, *whole]) == 0
    (found,) = read_table(folder / "sweeps" / "s" / "results.csv")
    assert found.config == row.config
    return found


def lands(row: ResultRow, known: Measured) -> bool:
    """Whether the rate is in the committed interval, or among the rates of the committed seeds."""
    low, high = known.seed_range or (known.estimate.value, known.estimate.value)
    return min(low, known.estimate.low) <= row.goal / row.episodes <= max(high, known.estimate.high)


def main() -> int:
    options = parse()
    rows = read_table(RESULTS / options.preset / "results.csv")
    results, table = Results(rows), Table(title=f"cells of preset {options.preset}, trained anew")
    for column in ("cell", "committed, all seeds", "that seed", "anew", "counts", "in the interval"):
        table.add_column(column)
    good = True
    for row in drawn(rows, options.cells, options.seed):
        with tempfile.TemporaryDirectory() as folder:
            anew = trained_anew(row, Path(folder))
        setup = Setup(row.robots, row.groups)
        known = success(results.fixed(row.method, setup))
        same = all(anew.count(outcome) == row.count(outcome) for outcome in ENDED)
        good &= lands(anew, known)
        rates = (f"{100 * each.goal / each.episodes:.1f} %" for each in (row, anew))
        name = f"{row.method} {setup} s{row.seed}"
        table.add_row(
            name, as_percent(known.estimate), *rates, "the same" if same else "others", str(lands(anew, known))
        )
    Console().print(table)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
