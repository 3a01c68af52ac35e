"""The command line's arguments, one dataclass a command; tyro makes flags and help of them."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, Suppress, UseCounterAction, arg

from learner.config import RunConfig
from learner.place import DEADLINE_S, START_DEADLINE_S, Place
from learner.presets import PresetName
from learner.sweep import SweepConfig
from sim_core.checks import require
from sim_core.config import MethodName

Switch = Annotated[UseCounterAction[int], arg(help_behavior_hint="(off by default)")]
"""A flag without a value: 0 unless it is given."""


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
    """The same for a part that is being started or saved."""

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
class Report:
    """Draw a sweep's figures and judge the dissertation's claims from its table of results."""

    results: Positional[Path]
    """A results.csv that `shoal sweep` wrote, or one of those in dashboards/results."""
    out: Path = Path("runs/report")
    """Folder for report.md, claims.md and the figures."""


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
class Evaluate:
    """Play a run's greedy policy, or a baseline, on fixed seeds and print its rates with 95 % intervals."""

    run: Positional[str]
    """Name of the run, or its folder; or fl-orca, greedy or random (a run of such a name: ./NAME)."""
    episodes: int = 1_000
    """Episodes to play."""
    first_seed: int = 2_000_000_000
    """Seed of the first episode; the others count on."""
    method: MethodName | None = None
    """Baselines only: method of the world to play in; sensor by default."""
    preset: PresetName | None = None
    """Baselines only: settings of the world to play in, those of `shoal sweep`; the defaults otherwise."""
    robots: int | None = None
    """Robots per group; by default those of the training (others: Extrapolation), or 10 for a baseline."""
    groups: int | None = None
    """Groups; by default those of the training (others: Extrapolation), or 2 for a baseline."""
    checkpoint: Literal["newest", "best"] = "newest"
    """The newest checkpoint's policy, or the one that did best in the evaluations during training."""
    out: Path | None = None
    """New file (.zarr) for the results: seed, outcome, length and return of every episode."""
    record: int = 0
    """Records the first episodes whole, this many, beside the results in FILE-episodes.zarr; needs --out."""
    runs_dir: Path = Path("runs")
    """Folder of all runs."""
    address: str | None = None
    """Ray cluster to join; RAY_ADDRESS or a Ray of its own on this machine by default."""

    def __post_init__(self) -> None:
        require(1 <= self.episodes <= 10**7, f"--episodes must be in 1..{10**7}, not {self.episodes}")
        require(
            0 <= self.first_seed <= 2**32 - 1 - self.episodes,
            f"--first-seed must be in 0..{2**32 - 1 - self.episodes}, not {self.first_seed}",
        )
        require(
            0 <= self.record <= self.episodes,
            f"--record must be in 0..{self.episodes} (--episodes), not {self.record}",
        )
        require(self.record == 0 or self.out is not None, "--record needs --out: episodes lie beside the results")
        require(
            self.out is None or (self.out.suffix == ".zarr" and bool(self.out.stem)),
            f"--out must name a file that ends in .zarr, not {str(self.out)!r}",
        )


@dataclass(frozen=True, kw_only=True)
class Watch:
    """Render one greedy episode of a run: a web page with a player, a video, or a strip of frames."""

    run: Positional[str]
    """Name of the run, or its folder."""
    format: Literal["html", "mp4", "png"] = "html"
    """Page with a player, video, or strip of frames (other environments than ours: video only)."""
    seed: int = 2_000_000_000
    """Seed of the episode."""
    out: Path | None = None
    """File to write; `episode-SEED` in the run's artifacts by default."""
    live: Switch = 0
    """Look into a running training: a page on 127.0.0.1 that plays the newest checkpoint's policy, again and again."""
    port: int = 8400
    """--live: port of the page; 0 takes a free one."""
    checkpoint: Literal["newest", "best"] = "newest"
    """The newest checkpoint's policy, or the one that did best in the evaluations during training."""
    runs_dir: Path = Path("runs")
    """Folder of all runs."""

    def __post_init__(self) -> None:
        require(0 <= self.seed < 2**32, f"--seed must be in 0..{2**32 - 1}, not {self.seed}")
        _check_port(self.port)
        require(
            not self.live or (self.format == "html" and self.out is None),
            "--live plays in a web page and writes no file; leave out --format and --out",
        )


@dataclass(frozen=True, kw_only=True)
class Chaos:
    """Train a small run while its processes are killed, frozen and delayed; print how long each took to recover."""

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
class Export:
    """Write a policy as ONNX and as a torch ExportedProgram, checked against the simulator."""

    run: Positional[str]
    """Name of the run, or its folder; or one of its checkpoints, or a policy.safetensors in its folder."""
    bare: bool = False
    """Observation to action values alone, for any environment; else from what a robot senses to its velocity."""
    out: Path | None = None
    """Folder to write, replaced if it is there; `export` or `export-bare` in the run's artifacts by default."""
    states: int = 10_000
    """States of rollouts in which both files must answer as the simulator and its policy do."""
    first_seed: int = 2_000_000_000
    """Seed of the first episode of these rollouts; the others count on."""
    runs_dir: Path = Path("runs")
    """Folder of all runs."""

    def __post_init__(self) -> None:
        require(1 <= self.states <= 1_000_000, f"--states must be in 1..1000000, not {self.states}")
        require(0 <= self.first_seed < 2**31, f"--first-seed must be in 0..{2**31 - 1}, not {self.first_seed}")


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


@dataclass(frozen=True, kw_only=True)
class Dashboard:
    """Show a sweep or a run as an HTML report with its episodes to play: one file, or a page that follows it live."""

    source: Positional[str]
    """A sweep (its name, its folder or a results.csv), or a run (its name or its folder)."""
    out: Path | None = None
    """File to write; dashboard.html beside the results by default."""
    serve: Switch = 0
    """Serve the report on 127.0.0.1 instead of writing it: it follows a running sweep or run, and plays any episode."""
    port: int = 8400
    """--serve: port of the page; 0 takes a free one."""
    episodes: int = 1
    """Episodes of each policy and outcome that the file takes with it; 0 for none."""
    episodes_mb: float = 5.0
    """... as long as all of them together take no more than this many megabytes."""
    runs_dir: Path = Path("runs")
    """Folder of all runs and sweeps."""

    def __post_init__(self) -> None:
        _check_port(self.port)
        require(self.episodes >= 0, f"--episodes must not be negative, not {self.episodes}")
        require(self.episodes_mb >= 0, f"--episodes-mb must not be negative, not {self.episodes_mb}")
        require(not self.serve or self.out is None, "--serve writes no file; leave out --out or --serve")


def _check_port(port: int) -> None:
    require(0 <= port <= 65535, f"--port must be in 0..65535, not {port}")


Command = Train | Sweep | Report | Resume | Evaluate | Watch | Dashboard | Chaos | Export | Submit
