"""`make overestimation`: what DQN and Double DQN expect during training, beside the returns that their policies get.

Trainings of the preset `thesis` (M_sensor, 10r×2g) with either algorithm and several seeds, evaluated often. Every
training logs the same numbers (`eval/q_visited`, `eval/return_visited`, `eval/q_start`, `eval/return_start`); this
collects them in a table, which `shoal report` reads where it stands beside results of the preset as `values.csv`.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from actors.evaluation.value_table import ValueRow, write_values
from actors.service.messages import VALUE_DTYPE
from dashboards.analysis.overestimation import late, overestimation
from learner.run_folder import RunFolder
from learner.tracking.journal import read_rows
from tests.benchmarks.trainings import trained

RUNS = Path("runs/overestimation")
ALGORITHMS = ("dqn", "double_dqn")


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.overestimation", description=__doc__)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="of the trainings")
    parser.add_argument("--runs-dir", type=Path, default=RUNS, help="finished trainings are kept")
    parser.add_argument("--out", type=Path, default=RUNS / "values.csv", help="the table")
    parser.add_argument("train", nargs="*", help="after --: settings of the trainings, as of `shoal train`")
    return parser.parse_args(arguments)


def rows_of(folder: RunFolder) -> Iterator[ValueRow]:
    """A row per evaluation during the training."""
    config = folder.config()
    world, total = config.world, config.total_env_steps
    training = ("thesis", world.method_name, world.robots, world.groups, config.algorithm, config.seed)
    for row in read_rows(folder.journal):
        if "eval/q_visited" in row.metrics:
            values = [round(row.metrics[f"eval/{name}"], 4) for name in VALUE_DTYPE.names]
            yield ValueRow(*training, row.env_steps, total, config.eval_episodes, *values)


def table(rows: list[ValueRow]) -> Table:
    """One row an algorithm: the means of the second half of its trainings."""
    found = Table(title="values less the returns that follow, second half of the trainings (95 % over trainings)")
    for name in ("algorithm", "value", "return", "value less return"):
        found.add_column(name, justify="left" if name == "algorithm" else "right")
    for algorithm in ALGORITHMS:
        measured = overestimation(rows, algorithm)
        assert measured is not None
        value, low, high = measured.estimate
        values, returns = (
            [getattr(row, name) for row in late(rows, algorithm)] for name in ("q_visited", "return_visited")
        )
        means = f"{np.mean(values):.3f}", f"{np.mean(returns):.3f}"
        found.add_row(algorithm, *means, f"{value:+.3f} ({low:+.3f} … {high:+.3f})")
    return found


def main(arguments: list[str] | None = None) -> int:
    options = parse(arguments)
    settings = ["--preset", "thesis", "--engine", "process", "--eval-every-env-steps", "50000"]
    settings += ["--final-eval-episodes", "100", *options.train]
    folders = [
        trained(options.runs_dir, f"{algorithm}-{seed}", ["--algorithm", algorithm, "--seed", str(seed), *settings])
        for seed in options.seeds
        for algorithm in ALGORITHMS
    ]
    rows = [row for folder in folders for row in rows_of(folder)]
    write_values(options.out, rows)
    Console(width=120).print(table(rows))
    print(options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
