"""What a method in a user's own file costs: trainings beside a built-in one of the same arithmetic."""

import statistics
import tempfile
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from unittest import mock

from rich.console import Console
from rich.table import Table

import deploy
from deploy.cli import main as shoal
from learner.run_folder import RunFolder
from learner.tracking.journal import read_rows
from sim_core.plugins import METHODS
from tests.benchmarks.timing import spread

ROUNDS = 3
EXAMPLES = Path(deploy.__file__).parent / "examples"
BUILT_IN = {"compass": "deploy.examples.compass_kernel:FastCompass"}
"""The example with a kernel as if it were one of the package's: not checked in every step."""
CONTENDERS = {
    "built-in, kernel": "compass",
    "own file, kernel": f"{EXAMPLES}/compass_kernel.py:FastCompass",
    "own file, numpy": f"{EXAMPLES}/compass.py:Compass",
}
SETTINGS = "--engine process --total-env-steps 250000 --min-replay 5000 --eval-episodes 1 --final-eval-episodes 1"
SETTINGS += " --eval-every-env-steps 1000000 --checkpoint-every-env-steps 1000000"


def training_rate(method: str, runs: Path, name: str) -> float:
    """Env steps per second of a training in one process, evaluations left out."""
    with redirect_stdout(StringIO()):
        arguments = ["train", *SETTINGS.split(), "--method", method, "--runs-dir", str(runs), "--name", name]
        if shoal(arguments):
            raise RuntimeError(f"the training with {method} failed")
    rows = read_rows(RunFolder(runs / name).journal)
    speed = "speed/env_steps_per_s"
    return statistics.median(row.metrics[speed] for row in rows[1:] if speed in row.metrics)


def main() -> None:
    found: dict[str, list[float]] = {name: [] for name in CONTENDERS}
    with mock.patch.dict(METHODS.built_in, BUILT_IN), tempfile.TemporaryDirectory() as folder:
        for i in range(ROUNDS + 1):
            for k, (name, method) in enumerate(CONTENDERS.items()):
                rate = training_rate(method, Path(folder), f"{i}-{k}")
                found[name] += [rate] if i else []  # the first round compiles kernels
    table = Table(title="trainings of a user's own method, 10r×2g, one process: env steps/s, and ratio to the built-in")
    for column in ("method", "env steps/s", "ratio"):
        table.add_column(column, justify="right")
    for name, values in found.items():
        ratios = [value / first for value, first in zip(values, found["built-in, kernel"], strict=True)]
        table.add_row(name, spread(values).text(), spread(ratios).text(2))
    Console().print(table)
