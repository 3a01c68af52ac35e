"""The command line's arguments for what trains, one dataclass a command; tyro makes flags and help of them."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tyro.conf import Positional, Suppress

from learner.config import RunConfig
from learner.placement import DEADLINE_S, START_DEADLINE_S, Place
from learner.presets import PresetName
from learner.sweep.grid import SweepConfig
from sim_core.checks import require


def ray_address(given: str | None) -> str | None:
    """The Ray cluster in force, None for a Ray of its own."""
    return given or os.environ.get("RAY_ADDRESS") or None


@dataclass(frozen=True, kw_only=True)
class OnRay:
    """On which Ray a run's parts are placed, and when one of them is late."""

    address: str | None = None
    """Ray cluster to join; RAY_ADDRESS or a Ray of its own on this machine by default."""
    deadline_s: float = DEADLINE_S
    """Seconds of silence after which a part of the run that owes an answer is replaced (Ray only)."""
    start_deadline_s: float = START_DEADLINE_S
    """The same for a part that is being started or restored."""

    def __post_init__(self) -> None:
        require(self.deadline_s >= 1, f"--deadline-s must be at least 1, not {self.deadline_s}")
        require(self.start_deadline_s >= 1, f"--start-deadline-s must be at least 1, not {self.start_deadline_s}")

    def ray_address(self) -> str | None:
        """The Ray cluster in force, None for a Ray of its own."""
        return ray_address(self.address)

    def place(self) -> Place:
        """Where the run's parts go."""
        return Place(self.ray_address(), self.deadline_s, self.start_deadline_s)


@dataclass(frozen=True, kw_only=True)
class Launch(OnRay):
    """Where a run is stored, logged and placed."""

    runs_dir: Path = Path("runs")
    """Folder of all runs."""
    name: str | None = None
    """Name of the run's folder; setup, seed and time by default."""
    tracking_uri: str | None = None
    """MLflow tracking URI; MLFLOW_TRACKING_URI or a sqlite file in runs_dir by default."""
    experiment: str = "shoal"
    """MLflow experiment."""

    def tracking(self) -> str:
        """The tracking URI in force."""
        default = f"sqlite:///{self.runs_dir.absolute() / 'mlflow.db'}"
        return self.tracking_uri or os.environ.get("MLFLOW_TRACKING_URI") or default

    def artifact_root(self) -> str | None:
        """Artifact folder of a new experiment: beside a local database, else the server's choice."""
        return str(self.runs_dir.absolute() / "mlartifacts") if self.tracking().startswith("sqlite:") else None

    def sweep_experiment(self, name: str) -> str:
        """MLflow experiment of a sweep: the given one, or one of its own."""
        return f"sweep {name}" if self.experiment == type(self).experiment else self.experiment


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train one setup from the start."""

    config: Path | None = None
    """TOML file with settings; flags override it. World settings stand under [world]."""
    preset: PresetName | None = None
    """Named settings of --method in place of the defaults, those of `shoal sweep`; flags override them."""
    or_resume: bool = False
    """Go on with the run of this --name where it is there, which must have the same settings; needs --name."""
    run: RunConfig = field(default_factory=RunConfig)
    """What to learn."""
    launch: Launch = field(default_factory=Launch)
    """Where."""
    checkpoint_url: str | None = None
    """Folder or fsspec URL (s3://bucket/path) for the run's checkpoints; its own folder by default."""
    keep_best: int = 1
    """Checkpoints that did best in the evaluations during training, kept beside the newest (--keep-checkpoints)."""

    def __post_init__(self) -> None:
        require(self.keep_best >= 0, f"--keep-best must be at least 0, not {self.keep_best}")


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """Train and evaluate a grid of setups; the same command again goes on where it was killed."""

    grid: SweepConfig = field(default_factory=SweepConfig)
    """Which setups."""
    launch: Launch = field(default_factory=Launch)
    """Where; the name is that of the sweep, its preset's by default."""
    at_once: int | None = None
    """Cells trained at once; one a CPU of the cluster by default."""
    known: Path | None = None
    """Results of an earlier sitting (a results.csv): cells that it holds in full are not run again."""

    def __post_init__(self) -> None:
        require(self.at_once is None or self.at_once >= 1, f"--at-once must be at least 1, not {self.at_once}")


@dataclass(frozen=True, kw_only=True)
class Resume(OnRay):
    """Go on with a run from its newest usable checkpoint."""

    run: Positional[str]
    """Name of the run, or its folder."""
    total_env_steps: int | None = None
    """Train on to this many env steps in all; the run's own number by default."""
    device: Literal["auto", "cpu", "cuda"] | None = None
    """Where the learner's networks live; as before by default."""
    runs_dir: Path = Path("runs")
    """Folder of all runs."""


@dataclass(frozen=True, kw_only=True)
class Chaos:
    """Train a small run while processes die, freeze or find their disk full; print how long each took to recover."""

    out: Path = Path("runs/chaos")
    """New folder for the run, its MLflow server's database and the logs."""
    seed: int = 0
    """Seed of the schedule of faults."""
    env_steps: int = 150_000
    """Env steps that the run must reach."""
    faults: int = 1_000
    """Faults to make at most."""
    every_s: float = 4.0
    """Mean time between two faults."""
    deadline_s: float = 10.0
    """Seconds of silence after which a part is replaced."""
    limit_s: float = 3_600.0
    """The run counts as hanging after so many seconds."""

    def __post_init__(self) -> None:
        require(self.env_steps > 1_024, f"--env-steps must be above 1024, not {self.env_steps}")
        require(self.faults >= 0, f"--faults must not be negative, not {self.faults}")
        require(self.every_s > 0, f"--every-s must be greater than 0, not {self.every_s}")
        require(self.deadline_s > 4, f"--deadline-s must be above 4, twice the longest delay, not {self.deadline_s}")
        require(self.limit_s > 0, f"--limit-s must be greater than 0, not {self.limit_s}")


@dataclass(frozen=True, kw_only=True)
class Submit:
    """Run `shoal train ...` or `shoal sweep ...` as a job of a Ray cluster, and follow its log.

    The command and its arguments come last, as they would stand after `shoal`. Ctrl-C stops the job, which saves a
    checkpoint; the same `shoal submit` again goes on with it, or follows it where it still runs.
    """

    address: str | None = None
    """The cluster's dashboard; RAY_API_SERVER_ADDRESS, or http://127.0.0.1:8265 by default."""
    working_dir: Path = Path(".")
    """A checkout of shoal, which the job runs; what its .gitignore names is not uploaded."""
    stop_wait_s: int = 120
    """Time that a stopped job has to save a checkpoint before it is killed."""
    follow: bool = True
    """Follow the job's log until it has ended; else return once it is submitted."""
    command: Suppress[tuple[str, ...]] = ()
    """The job's command, `train` or `sweep`, with its arguments."""

    def __post_init__(self) -> None:
        require(self.stop_wait_s >= 1, f"--stop-wait-s must be at least 1, not {self.stop_wait_s}")
