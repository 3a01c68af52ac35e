"""`make reproduce`: trains some cells of the committed results anew, and says whether they land where those let expect.

With the arithmetic and the learning code of the sitting that made a cell its counts are the same; else one training in
twenty lands outside by chance.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import get_args

import numpy as np
from rich.console import Console
from rich.table import Table

import dashboards
from actors.evaluation.result_table import LEARNED, ResultRow, read_table
from actors.evaluation.statistics import Estimate, as_percent, rate
from dashboards.analysis.aggregate import PooledCell, Results, Setup
from deploy.cli import main as shoal
from learner.presets import PresetName
from sim_core.outcomes import ENDED, Outcome

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
    setup = f"--methods {row.method} --robots {row.robots} --groups {row.groups} --seeds {row.seed}".split()
    whole = ["--preset", row.preset, "--extrapolation", "none", "--baselines", "--runs-dir", str(folder), "--name", "s"]
    assert shoal(["sweep", *setup, *whole]) == 0
    (found,) = read_table(folder / "sweeps" / "s" / "results.csv")
    assert found.config == row.config
    return found


def expected(cell: PooledCell, spread: float) -> Estimate:
    """The 95 % prediction interval of one more training's success rate, from those that are committed.

    Args:
      cell: the committed ones.
      spread: how many times as much counts of different seeds vary as binomial ones.
    """
    return rate(cell.count(Outcome.GOAL), cell.episodes, spread * (len(cell.rows) + 1))


def main() -> int:
    options = parse()
    rows = read_table(RESULTS / options.preset / "results.csv")
    several = Results(read_table(RESULTS / "thesis" / "results.csv"))  # three seeds, which tell how much they differ
    results, table = Results(rows), Table(title=f"cells of preset {options.preset}, trained anew")
    for column in ("cell", "expected of one more", "committed", "anew", "counts", "as expected"):
        table.add_column(column)
    good = True
    for row in drawn(rows, options.cells, options.seed):
        with tempfile.TemporaryDirectory() as folder:
            anew = trained_anew(row, Path(folder))
        setup = Setup(row.robots, row.groups)
        known = expected(
            results.fixed(row.method, setup), several.fixed(row.method, setup).overdispersion[Outcome.GOAL]
        )
        same = all(anew.count(outcome) == row.count(outcome) for outcome in ENDED)
        lands = same or known.low <= anew.goal / anew.episodes <= known.high
        good &= lands
        rates = (f"{100 * each.goal / each.episodes:.1f} %" for each in (row, anew))
        verdict = ("the same" if same else "others", "yes" if lands else "no")
        table.add_row(f"{row.method} {setup} s{row.seed}", as_percent(known), *rates, *verdict)
    Console().print(table)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
