"""The command line's arguments, one dataclass a command; tyro makes flags and help of them."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from learner.config import RunConfig
from learner.presets import PresetName
from learner.sweep import SweepConfig
from sim_core.checks import require


@dataclass(frozen=True, kw_only=True)
class Launch:
    """Where a run is stored, logged and placed."""

    runs_dir: Path = Path("runs")
    """Folder of all runs."""
    name: str | None = None
    """Name of the run's folder; setup, seed and time by default."""
    tracking_uri: str | None = None
    """MLflow tracking URI; MLFLOW_TRACKING_URI or a sqlite file in runs_dir by default."""
    experiment: str = "shoal"
    """MLflow experiment."""
    address: str | None = None
    """Ray cluster to join; RAY_ADDRESS or a Ray of its own on this machine by default."""

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

    def ray_address(self) -> str | None:
        """The Ray cluster in force, None for a Ray of its own."""
        return ray_address(self.address)


def ray_address(given: str | None) -> str | None:
    """The Ray cluster in force, None for a Ray of its own."""
    return given or os.environ.get("RAY_ADDRESS") or None


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train one setup from the start."""

    config: Path | None = None
    """TOML file with settings; flags override it. World settings stand under [world]."""
    preset: PresetName | None = None
    """Named settings of --method in place of the defaults, those of `shoal sweep`; flags override them."""
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
class Resume:
    """Go on with a run from its newest usable checkpoint."""

    run: Positional[str]
    """Name of the run, or its folder."""
    total_env_steps: int | None = None
    """Train on to this many env steps in all; the run's own number by default."""
    runs_dir: Path = Path("runs")
    """Folder of all runs."""
    address: str | None = None
    """Ray cluster to join; RAY_ADDRESS or a Ray of its own on this machine by default."""


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Play a run's greedy policy, or a baseline, on fixed seeds and print its rates with 95 % intervals."""

    run: Positional[str]
    """Name of the run, or its folder; or fl-orca, greedy or random (a run of such a name: ./NAME)."""
    episodes: int = 1_000
    """Episodes to play."""
    first_seed: int = 2_000_000_000
    """Seed of the first episode; the others count on."""
    method: Literal["sensor", "in", "out"] | None = None
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
    checkpoint: Literal["newest", "best"] = "newest"
    """The newest checkpoint's policy, or the one that did best in the evaluations during training."""
    runs_dir: Path = Path("runs")
    """Folder of all runs."""

    def __post_init__(self) -> None:
        require(0 <= self.seed < 2**32, f"--seed must be in 0..{2**32 - 1}, not {self.seed}")


Command = Train | Sweep | Report | Resume | Evaluate | Watch
