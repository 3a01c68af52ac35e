"""Small runs for integration tests."""

import contextlib
import dataclasses
import functools
import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.cli import main
from learner.config import RunConfig
from tests.small_run import SMALL

PATIENCE_S = 600.0
"""Longer than anything takes on a busy machine, and less than pytest's timeout, so that a failure shows its log."""


@pytest.fixture
def small() -> RunConfig:
    """A run of a few seconds."""
    return dataclasses.replace(SMALL)


@pytest.fixture
def shoal(tmp_path: Path):
    """Runs the command `shoal` in a process of its own, in an empty folder."""
    return functools.partial(run_shoal, tmp_path)


def run_shoal(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """The command `shoal`, run in `folder` in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "deploy", *arguments],
        cwd=folder,
        env=clean_environment(),
        capture_output=True,
        text=True,
        check=False,
    )


def run_here(*arguments: str) -> str:
    """What the command `shoal` prints, run to its end in this process, which has its libraries loaded already."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        assert main(arguments) == 0
    return out.getvalue()


def clean_environment() -> dict[str, str]:
    """This process's environment without what would redirect a run or let it into this process's own Ray."""
    return {name: value for name, value in os.environ.items() if not name.startswith(("RAY_", "MLFLOW_TRACKING"))}


def flags(config: RunConfig) -> list[str]:
    """The command line that says `config`."""
    result = []
    plain = dataclasses.asdict(config)
    world = plain.pop("world")
    defaults = dataclasses.asdict(RunConfig())
    default_world = defaults.pop("world")
    for values, default in ((plain, defaults), (world, default_world)):
        for name, value in values.items():
            if value != default[name] and name != "sources":
                items = value if isinstance(value, tuple) else (value,)
                result += [f"--{name.replace('_', '-')}", *map(str, items)]
    return result
