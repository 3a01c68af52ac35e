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
from sim_core.config import WorldConfig

PATIENCE_S = 600.0
"""Longer than anything takes on a busy machine, and less than pytest's timeout, so that a failure shows its log."""
SMALL_WORLD = WorldConfig(robots=3, groups=2, horizon_steps=60)
SMALL = RunConfig(
    world=SMALL_WORLD,
    engine="process",
    total_env_steps=6_000,
    envs_per_worker=8,
    steps_per_block=16,
    min_replay=512,
    replay_capacity=4_000,
    samples_per_insert=4.0,
    batch_size=32,
    updates_per_call=4,
    hidden_sizes=(16,),
    n_step=2,
    target_update_interval=20,
    epsilon_decay_env_steps=2_000,
    learning_rate_decay_env_steps=5_000,
    eval_every_env_steps=2_000,
    eval_episodes=6,
    final_eval_episodes=8,
    log_every_env_steps=1_000,
    checkpoint_every_env_steps=2_000,
)


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
