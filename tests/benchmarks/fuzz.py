"""`make fuzz`: thousands of command lines, config files and environments at random; what came of them, or a fault."""

import argparse
import sys
import tempfile
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, seed, settings
from rich.console import Console
from rich.table import Table

from learner.ray_backend.auth import guard_ray

guard_ray(joins=False)  # before Ray is imported

from tests.integration import env_fuzzing  # noqa: E402
from tests.integration.fuzzing import KINDS, Counts, workplace  # noqa: E402

ENVIRONMENTS = "environments"
CASES = {"command lines": 4_000, "config files": 5_000, "config files with flags": 2_000, ENVIRONMENTS: 2_000}


def fuzz(kind: str, count: int, start: int) -> Counts:
    """Checks `count` cases of a kind; a fault comes out as an AssertionError with the smallest case that shows it."""
    cases, check = KINDS.get(kind, (env_fuzzing.CASES, env_fuzzing.check_env))
    counts = Counts()

    @seed(start)
    @settings(
        max_examples=count,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.generate, Phase.shrink],
    )
    @given(cases)
    def run(case):
        counts.take(check(case))

    run()
    return counts


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.fuzz", description=__doc__)
    parser.add_argument("--kinds", nargs="+", choices=list(CASES), default=list(CASES), help="what to fuzz")
    parser.add_argument("--share", type=float, default=1.0, help="share of the cases to run; default: all")
    parser.add_argument("--seed", type=int, default=0, help="other cases for every seed")
    options = parser.parse_args(arguments)
    table = Table(title=f"fuzz, seed {options.seed}: one sentence where something is refused, no traceback")
    for column in ("kind", "cases", "refused", "came to work or help", "slowest"):
        table.add_column(column, justify="right")
    total = 0
    for kind in options.kinds:
        place = env_fuzzing.env_workplace if kind == ENVIRONMENTS else workplace
        with tempfile.TemporaryDirectory() as folder, place(Path(folder)):
            found = fuzz(kind, max(1, round(CASES[kind] * options.share)), options.seed)
            cases, refused = found.outcomes.total(), found.outcomes["refused"]
            table.add_row(kind, f"{cases:,}", f"{refused:,}", f"{cases - refused:,}", f"{found.slowest_s:.2f} s")
            total += cases
    console = Console(width=120)
    console.print(table)
    console.print(f"{total:,} cases, no fault", highlight=False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
