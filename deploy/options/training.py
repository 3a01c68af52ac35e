"""Command-line options of the commands that train, one dataclass per command; tyro turns fields into flags and help."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tyro.conf import Fixed, Positional, Suppress

from deploy.options.results import Switch
from learner.cluster_options import DEADLINE_S, START_DEADLINE_S, ClusterOptions
from learner.config import RunConfig
from learner.presets import TrainingPreset
from learner.search.config import SearchConfig
from learner.search.space import FORMS
from learner.sweep.grid import SweepConfig
from learner.tracking.local_store import ARTIFACTS, DATABASE, sqlite_uri
from learner.tracking.redaction import VARIABLE
from sim_core.checks import require


def ray_address(given: str | None) -> str | None:
    """The Ray cluster to join: the given one, else RAY_ADDRESS; None starts a Ray on this machine."""
    return given or os.environ.get("RAY_ADDRESS") or None


@dataclass(frozen=True, kw_only=True)
class RayOptions:
    """Which Ray runs the components, and when one of them is late."""

    address: str | None = None
    """Ray cluster to join; RAY_ADDRESS by default, else a Ray on this machine."""
    deadline_s: float = DEADLINE_S
    """Seconds of silence after which a component that owes an answer is replaced; in one process, longest
    time of one step of a user's environment."""
    start_deadline_s: float = START_DEADLINE_S
    """The same for a component that is starting or being restored."""
    spares: int = 0
    """Warm spares to keep of the rollout workers, and of shards with actors of their own (Ray only): processes with all
    code loaded, which take a lost one's place at once. Each takes memory and, on a cluster, a CPU."""

    def __post_init__(self) -> None:
        require(self.deadline_s >= 1, f"--deadline-s must be at least 1, not {self.deadline_s}")
        require(self.start_deadline_s >= 1, f"--start-deadline-s must be at least 1, not {self.start_deadline_s}")
        require(self.spares >= 0, f"--spares must not be negative, not {self.spares}")

    def ray_address(self) -> str | None:
        """The Ray cluster to join; None starts a Ray on this machine."""
        return ray_address(self.address)

    def cluster_options(self) -> ClusterOptions:
        """Where the components run, and their deadlines."""
        return ClusterOptions(self.ray_address(), self.deadline_s, self.start_deadline_s, self.spares)


@dataclass(frozen=True, kw_only=True)
class Launch(RayOptions):
    """Where a run is stored, logged and placed."""

    runs_dir: Path = Path("runs")
    """Folder of all runs."""
    name: str | None = None
    """Name of the run's folder; setup, seed and time by default."""
    tracking_uri: str | None = None
    """MLflow tracking URI; MLFLOW_TRACKING_URI by default, else a sqlite file in runs_dir."""
    experiment: str = "shoal"
    """MLflow experiment."""

    def tracking(self) -> str:
        """The tracking URI in force."""
        return self.tracking_uri or os.environ.get(VARIABLE) or sqlite_uri(self.runs_dir / DATABASE)

    def artifact_root(self) -> str | None:
        """Artifact folder of a new experiment: beside a local database; None leaves the choice to the server."""
        return str(self.runs_dir.absolute() / ARTIFACTS) if self.tracking().startswith("sqlite:") else None

    def experiment_of(self, kind: str, name: str) -> str:
        """MLflow experiment of the sweep or search `name`: the given one, or one of its own."""
        return f"{kind} {name}" if self.experiment == type(self).experiment else self.experiment


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train one setup from the start."""

    config: Path | None = None
    """TOML file with settings, or a config of shoal (cartpole); flags override it. World settings are under [world]."""
    preset: TrainingPreset | None = None
    """Named settings of --method in place of the defaults: those of `shoal sweep`, or of one policy for all setups."""
    or_resume: bool = False
    """Resume the run of this --name if it exists; it must have the same settings. Needs --name."""
    supervise: Switch = 0
    """Go on by itself when the driver is killed: a small process watches it, and resumes the run."""
    run: RunConfig = field(default_factory=RunConfig)
    """What to learn."""
    launch: Launch = field(default_factory=Launch)
    """Where."""
    checkpoint_url: str | None = None
    """Folder or fsspec URL (s3://bucket/path) for the run's checkpoints; the run's folder by default."""
    keep_best: int = 1
    """Checkpoints with the best evaluations during training that are kept beside the newest (--keep-checkpoints)."""

    def __post_init__(self) -> None:
        require(self.keep_best >= 0, f"--keep-best must be at least 0, not {self.keep_best}")


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """Train and evaluate a grid of setups; after a kill, the same command runs what is missing."""

    grid: SweepConfig = field(default_factory=SweepConfig)
    """Which setups."""
    launch: Launch = field(default_factory=Launch)
    """Where; the name is that of the sweep, its preset's by default."""
    at_once: int | None = None
    """Cells trained at once; one per CPU of the cluster by default."""
    known: Path | None = None
    """Results of an earlier sweep (a results.csv); cells that it holds in full are not run again."""

    def __post_init__(self) -> None:
        require(self.at_once is None or self.at_once >= 1, f"--at-once must be at least 1, not {self.at_once}")


@dataclass(frozen=True, kw_only=True)
class Search:
    """Search settings for objectives with Optuna; after a kill, the same command goes on."""

    search: SearchConfig = field(default_factory=SearchConfig)
    """What to vary, and what for."""
    launch: Launch = field(default_factory=Launch)
    """Where; the name is that of the search, what it varies by default."""
    at_once: int | None = None
    """Trials run at once; one per CPU of the cluster by default."""
    dry_run: Switch = 0
    """Say how long the search will take, from rates measured here, and run nothing."""

    def __post_init__(self) -> None:
        require(len(self.search.space) > 0, f"name what to vary, as in --space {FORMS.replace(', ', ' ', 1)}")
        require(self.at_once is None or self.at_once >= 1, f"--at-once must be at least 1, not {self.at_once}")


@dataclass(frozen=True, kw_only=True)
class Resume(RayOptions):
    """Resume a run from its newest usable checkpoint."""

    run: Positional[str]
    """Name of the run, or its folder."""
    total_env_steps: int | None = None
    """Train until this many env steps in total; the run's own number by default."""
    device: Literal["auto", "cpu", "cuda"] | None = None
    """Where the learner's networks live; as before by default."""
    runs_dir: Path = Path("runs")
    """Folder of all runs."""


@dataclass(frozen=True, kw_only=True)
class Chaos:
    """Train a small run while processes are killed, frozen or find their disk full; print the recovery times."""

    out: Path = Path("runs/chaos")
    """New folder for the run, its MLflow server's database and the logs."""
    seed: int = 0
    """Seed of the schedule of faults."""
    env_steps: int = 150_000
    """Env steps that the run must reach."""
    faults: int = 1_000
    """Faults to inject at most."""
    every_s: float = 4.0
    """Mean time between two faults."""
    deadline_s: float = 10.0
    """Seconds of silence after which a component is replaced."""
    spares: int = 0
    """Warm spares of the run (see `shoal train`)."""
    limit_s: float = 3_600.0
    """The run counts as hung after this many seconds."""

    def __post_init__(self) -> None:
        require(self.env_steps > 1_024, f"--env-steps must be above 1024, not {self.env_steps}")
        require(self.faults >= 0, f"--faults must not be negative, not {self.faults}")
        require(self.every_s > 0, f"--every-s must be greater than 0, not {self.every_s}")
        require(self.deadline_s > 4, f"--deadline-s must be above 4, twice the longest delay, not {self.deadline_s}")
        require(self.spares >= 0, f"--spares must not be negative, not {self.spares}")
        require(self.limit_s > 0, f"--limit-s must be greater than 0, not {self.limit_s}")


@dataclass(frozen=True, kw_only=True)
class Submit:
    """Run `shoal train ...` or `shoal sweep ...` as a job on a Ray cluster, and follow its log.

    The command and its arguments come last, exactly as after `shoal`. Ctrl-C stops the job, which then saves a
    checkpoint. The same `shoal submit` again resumes it, or follows it if it is still running.
    """

    address: str | None = None
    """The cluster's dashboard; RAY_API_SERVER_ADDRESS by default, else http://127.0.0.1:8265."""
    working_dir: Path = Path(".")
    """A checkout of shoal, which the job runs; files that its .gitignore names are not uploaded."""
    stop_wait_s: int = 120
    """Seconds that a stopped job has to save a checkpoint before it is killed."""
    follow: bool = True
    """Follow the job's log until it has ended; otherwise return once it is submitted."""
    arguments: Suppress[Fixed[tuple[str, ...]]] = ()
    """The job's command line after `shoal`."""
    job: Suppress[Fixed[Train | Sweep | None]] = None
    """The same, parsed."""

    def __post_init__(self) -> None:
        require(self.stop_wait_s >= 1, f"--stop-wait-s must be at least 1, not {self.stop_wait_s}")
