"""Command-line options of the commands that use results of a run or a sweep: evaluations, pages, figures, exports."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseCounterAction, arg

from actors.evaluation.conditions import grid, parse_axis, parse_condition
from learner.presets import PresetName
from sim_core.checks import require

Switch = Annotated[UseCounterAction[int], arg(help_behavior_hint="(off by default)")]
"""A flag without a value; 0 unless it is given."""


@dataclass(frozen=True, kw_only=True)
class Report:
    """Draw figures and judge the dissertation's claims from a sweep's table of results."""

    results: Positional[tuple[Path, ...]]
    """Tables of results: a results.csv of `shoal sweep`, or of dashboards/results. Several are shown side by side; a
    variants.csv beside one, a table of its preset with other settings, is compared with."""
    out: Path = Path("runs/report")
    """Folder for report.md, claims.md and the figures."""

    def __post_init__(self) -> None:
        require(len(self.results) > 0, "name the results.csv of a sweep, as in `shoal report results.csv`")


@dataclass(frozen=True, kw_only=True)
class Players:
    """Who plays which episodes where."""

    run: Positional[tuple[str, ...]]
    """Names of runs, or their folders; or fl-orca, fl-orca-snapped, greedy, field, random (a run so named: ./NAME)."""
    episodes: int = 1_000
    """Episodes to play."""
    first_seed: int = 2_000_000_000
    """Seed of the first episode; the others follow it."""
    method: str | None = None
    """Baselines only: method of the world to play in; sensor by default."""
    preset: PresetName | None = None
    """Baselines only: preset of the world to play in, as in `shoal sweep`; the defaults otherwise."""
    robots: int | None = None
    """Robots per group; by default those of the training, or 10 for a baseline. Others test Extrapolation."""
    groups: int | None = None
    """Groups; by default those of the training, or 2 for a baseline. Others test Extrapolation."""
    learners: str | None = None
    """Learning robots of a world, as of `shoal train`: one, a count or a share of every group; by default those of the
    training, or one for a baseline."""
    checkpoint: str = "newest"
    """The policy's checkpoint: newest, best (by the evaluations during training), or a name (step-…)."""
    runs_dir: Path = Path("runs")
    """Folder of all runs."""
    address: str | None = None
    """Ray cluster to join; RAY_ADDRESS by default, else a Ray on this machine."""

    def __post_init__(self) -> None:
        require(len(self.run) > 0, "name a run, or a baseline, as in `shoal evaluate greedy`")
        require(len(set(self.run)) == len(self.run), f"name each player once, not {' '.join(self.run)}")
        require(1 <= self.episodes <= 10**7, f"--episodes must be in 1..{10**7}, not {self.episodes}")
        require(
            0 <= self.first_seed <= 2**32 - 1 - self.episodes,
            f"--first-seed must be in 0..{2**32 - 1 - self.episodes}, not {self.first_seed}",
        )


@dataclass(frozen=True, kw_only=True)
class Evaluate(Players):
    """Play greedy policies of runs, or baselines, on fixed seeds; print rates with 95 % intervals.

    Several players meet the same start scenes; their differences to the first are paired.
    """

    under: tuple[str, ...] = ()
    """Conditions to play under alone, NAME=VALUE, as in `shoal stress --vary`; as trained by default."""
    out: Path | None = None
    """New .zarr file for the results: seed, outcome, length and return of every episode."""
    record: int = 0
    """Number of first episodes whose trajectories are stored in FILE-episodes.zarr beside the results; needs --out."""

    def __post_init__(self) -> None:
        super().__post_init__()
        parse_condition(self.under)
        require(len(self.run) == 1 or self.out is None, "--out stores the results of one player; evaluate it alone")
        require(
            0 <= self.record <= self.episodes,
            f"--record must be in 0..{self.episodes} (--episodes), not {self.record}",
        )
        require(
            self.record == 0 or self.out is not None, "--record needs --out: episodes are stored beside the results"
        )
        require(
            self.out is None or (self.out.suffix == ".zarr" and bool(self.out.stem)),
            f"--out must name a file that ends in .zarr, not {str(self.out)!r}",
        )


@dataclass(frozen=True, kw_only=True)
class Stress(Players):
    """Play policies and rules under a grid of bad senses and late commands; print and draw where they break.

    All players meet the same start scenes under every condition; differences are paired. What was played is stored,
    and the same command plays what is missing.
    """

    vary: tuple[str, ...] = (
        "position_loss=0,0.25,0.5,0.75",
        "position_noise_m=0,0.1,0.3",
        "position_delay_steps=0,5,10",
        "dropped_mates=0,2",
    )
    """Axes of the grid, NAME=VALUE,VALUE,...: senses, commands, shield, kinematics; an unknown NAME lists them all."""
    name: str | None = None
    """Name of the results' folder under RUNS_DIR/stress; made of the players' names by default."""

    def __post_init__(self) -> None:
        super().__post_init__()
        grid([parse_axis(text) for text in self.vary])


@dataclass(frozen=True, kw_only=True)
class Watch:
    """Show one greedy episode of a run as a web page with a player, a video, or a strip of frames."""

    run: Positional[str]
    """Name of the run, or its folder."""
    format: Literal["html", "mp4", "png"] = "html"
    """Page with a player, video, or strip of frames; for other environments than ours, video only."""
    seed: int = 2_000_000_000
    """Seed of the episode."""
    under: tuple[str, ...] = ()
    """Conditions to play under alone, NAME=VALUE, as in `shoal stress --vary`; as trained by default."""
    out: Path | None = None
    """File to write; `episode-SEED` in the run's artifacts by default."""
    live: Switch = 0
    """Serve a page on 127.0.0.1 that follows a running training and plays the newest checkpoint's policy."""
    drive: Switch = 0
    """Serve a page on which you drive 25 scenes, beside policy, rules and FL-ORCA; with --format: that of --seed."""
    port: int = 8400
    """--live, --drive: port of the page; 0 takes a free one."""
    checkpoint: str = "newest"
    """The policy's checkpoint: newest, best (by the evaluations during training), or a name (step-…)."""
    runs_dir: Path = Path("runs")
    """Folder of all runs."""

    def __post_init__(self) -> None:
        parse_condition(self.under)
        require(0 <= self.seed < 2**32, f"--seed must be in 0..{2**32 - 1}, not {self.seed}")
        _check_port(self.port)
        require(
            not self.live or (self.format == "html" and self.out is None),
            "--live plays in a web page and writes no file; leave out --format and --out",
        )
        require(not (self.live and self.drive), "--live and --drive serve a page each; leave one of them out")
        require(
            not self.drive or self.format != "html" or self.out is None,
            "--drive serves a page and writes no file; leave out --out, or name a --format for what was driven",
        )


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a policy as ONNX and as a torch ExportedProgram, checked against the simulator."""

    run: Positional[str]
    """Name of the run, or its folder; or the path of a checkpoint, or of a policy.safetensors in its folder."""
    bare: bool = False
    """Export observation to action values, for any environment; otherwise what a robot senses to its velocity."""
    out: Path | None = None
    """Folder to write, replaced if it exists; `export` or `export-bare` in the run's artifacts by default."""
    states: int = 10_000
    """States from rollouts in which both files must agree with the simulator and its policy."""
    first_seed: int = 2_000_000_000
    """Seed of the first episode of these rollouts; the others follow it."""
    runs_dir: Path = Path("runs")
    """Folder of all runs."""

    def __post_init__(self) -> None:
        require(1 <= self.states <= 1_000_000, f"--states must be in 1..1000000, not {self.states}")
        require(0 <= self.first_seed < 2**31, f"--first-seed must be in 0..{2**31 - 1}, not {self.first_seed}")


@dataclass(frozen=True, kw_only=True)
class Dashboard:
    """Show a sweep or a run as an HTML report with playable episodes: one file, or a page that follows it live."""

    source: Positional[str]
    """A sweep (its name, its folder or a results.csv), a search or a run (its name or its folder)."""
    out: Path | None = None
    """File to write; dashboard.html beside the results by default."""
    serve: Switch = 0
    """Serve the report on 127.0.0.1 instead of writing it; it follows a running sweep or run, and plays any episode."""
    port: int = 8400
    """--serve: port of the page; 0 takes a free one."""
    episodes: int = 1
    """Episodes of each policy and outcome that the file embeds; 0 for none."""
    episodes_mb: float = 5.0
    """Size limit of all embedded episodes together, in megabytes."""
    runs_dir: Path = Path("runs")
    """Folder of all runs and sweeps."""

    def __post_init__(self) -> None:
        _check_port(self.port)
        require(self.episodes >= 0, f"--episodes must not be negative, not {self.episodes}")
        require(self.episodes_mb >= 0, f"--episodes-mb must not be negative, not {self.episodes_mb}")
        require(not self.serve or self.out is None, "--serve writes no file; leave out --out or --serve")


@dataclass(frozen=True, kw_only=True)
class Relocate:
    """Let MLflow find its artifacts again after a folder of runs was moved or copied.

    `shoal train`, `resume` and `sweep` do so by themselves; MLflow's own page and clients need it.
    """

    runs_dir: Path = Path("runs")
    """Folder of all runs, where it is now."""


def _check_port(port: int) -> None:
    require(0 <= port <= 65535, f"--port must be in 0..65535, not {port}")
