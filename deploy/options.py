"""The command line's arguments, one dataclass a command; tyro makes flags and help of them."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from learner.config import RunConfig
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
    run: RunConfig = field(default_factory=RunConfig)
    """What to learn."""
    launch: Launch = field(default_factory=Launch)
    """Where."""


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
    """Play the greedy policy of a run on fixed seeds and print its rates with 95 % intervals."""

    run: Positional[str]
    """Name of the run, or its folder."""
    episodes: int = 1_000
    """Greedy episodes."""
    first_seed: int = 2_000_000_000
    """Seed of the first episode; the others count on."""
    robots: int | None = None
    """Robots per group to play on, if not those of the training (Extrapolation)."""
    groups: int | None = None
    """Groups to play on, if not those of the training (Extrapolation)."""
    runs_dir: Path = Path("runs")
    """Folder of all runs."""
    address: str | None = None
    """Ray cluster to join; RAY_ADDRESS or a Ray of its own on this machine by default."""

    def __post_init__(self) -> None:
        require(self.episodes >= 1, f"--episodes must be at least 1, not {self.episodes}")
        require(
            0 <= self.first_seed <= 2**32 - 1 - self.episodes,
            f"--first-seed must be in 0..{2**32 - 1 - self.episodes}, not {self.first_seed}",
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
    runs_dir: Path = Path("runs")
    """Folder of all runs."""

    def __post_init__(self) -> None:
        require(0 <= self.seed < 2**32, f"--seed must be in 0..{2**32 - 1}, not {self.seed}")


Command = Train | Resume | Evaluate | Watch
