"""`make robustness`: policies trained for bad senses beside policies trained without, and beside the rules.

For every method, trainings of the preset `generalist` in three setups with several seeds: `clean`; `drawn`, with
conditions drawn for every episode (domain randomisation); `drawn, history`, which also sees what it sensed before;
`drawn, tracked`, which takes robots that it does not sense any more to go on with their last velocity; and `drawn,
tracked, shield`, which also keeps ORCA's half-planes against the robots it takes to be there. All policies and rules
meet the same start scenes under each condition by itself. Differences are paired: an episode's mean over the trainings,
less that of `clean` without any condition. A player breaks where its success falls to 50 %.
"""

import argparse
import csv
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from actors.evaluation.conditions import Axis, breaking_point, grid, parse_axis
from actors.evaluation.statistics import Estimate, mean, mean_share
from actors.policy.baselines import Baseline, exists
from dashboards.figures.stress_curves import Panel, stress_curves_png
from deploy.console.summary_tables import signed_percent
from deploy.options.results import Stress
from deploy.playing.players import find_players
from deploy.playing.stress_results import StressResults
from learner.run_folder import RunFolder
from sim_core.config import WorldConfig
from sim_core.plugins import METHODS, find
from tests.benchmarks.trainings import study_parser, trained

SETUPS = ("5x2", "10x4", "25x4")
ENV_STEPS = 600_000
CLEAN = "clean"
DRAWN = (
    *("--conditions", "drawn", "--position-loss", "0.75", "--position-noise-m", "0.1"),
    *("--position-delay-steps", "3", "--dropped-mates", "1"),
)
FADES = ("--teacher-weight-end", "0", "--teacher-decay-env-steps", str(ENV_STEPS // 3))
"""The teacher of M_IN and M_OUT is a rule for good senses: unless robots are tracked, it has no say in the end."""
KINDS = {
    CLEAN: (),
    "drawn": (*DRAWN, *FADES),
    "drawn, history": (*DRAWN, *FADES, "--history", "4"),
    "drawn, tracked": (*DRAWN, "--track-steps", "20"),
    "drawn, tracked, shield": (*DRAWN, "--track-steps", "20", "--shield", "orca"),
}
"""Settings that the trainings differ in."""
AXES = tuple(
    parse_axis(text)
    for text in (
        "position_loss=0,0.25,0.5,0.75,0.9",
        "position_noise_m=0,0.1,0.2,0.3,0.5",
        "position_delay_steps=0,2,5,10",
        "dropped_mates=0,1,2,3,4",
    )
)
SHOWN = (("position_loss", 0.0), ("position_loss", 0.5), ("position_noise_m", 0.3), ("position_delay_steps", 10)) + (
    ("dropped_mates", 2),
)
"""Conditions of the printed table; the CSV file and the figure have all."""


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = study_parser("tests.benchmarks.robustness", __doc__, 300, Path("runs/robustness"))
    names = [axis.name for axis in AXES]
    parser.add_argument("--conditions", nargs="+", choices=names, default=names, help="to play under")
    return parser.parse_args(arguments)


def axes_of(options: argparse.Namespace) -> list[Axis]:
    """The conditions to play under."""
    return [axis for axis in AXES if axis.name in options.conditions]


def run_name(method: str, kind: str, seed: int) -> str:
    return f"{method}-{kind.replace(', ', '-')}-{seed}"


def training(method: str, kind: str, seed: int, settings: tuple[str, ...], options: argparse.Namespace) -> RunFolder:
    """The run of one training of the preset `generalist` in `SETUPS`, which is made unless it is there."""
    steps = str(ENV_STEPS)
    common = ["--preset", "generalist", "--method", method, "--engine", "process", "--setups", *SETUPS]
    common += ["--total-env-steps", steps, "--learning-rate-decay-env-steps", steps]
    common += ["--eval-every-env-steps", steps, "--checkpoint-every-env-steps", steps]
    common += ["--eval-episodes", "100", "--final-eval-episodes", "100"]  # the study plays its own
    name = run_name(method, kind, seed)
    return trained(options.runs_dir, name, [*common, "--seed", str(seed), *settings, *options.train])


def rules_of(world: WorldConfig) -> list[Baseline]:
    """The rules that play in such a world."""
    return [rule for rule in (Baseline.GREEDY, Baseline.FIELD, Baseline.FL_ORCA) if exists(rule, world)]


def train(method: str, options: argparse.Namespace) -> list[str]:
    """Names of all trainings, which are made unless they are there, and of the rules."""
    names = []
    for seed in options.seeds:
        for kind, settings in KINDS.items():
            names.append(run_name(method, kind, seed))
            world = training(method, kind, seed, settings, options).config().world
    return [*names, *map(str, rules_of(world))]


class Curve(NamedTuple):
    """A player's successes along an axis in one setup, the mean over its trainings: `[values, episodes]`."""

    axis: Axis
    setup: str
    player: str
    goals: NDArray[np.float64]

    @property
    def rates(self) -> list[Estimate]:
        return [mean_share(goals) for goals in self.goals]


def curves(method: str, names: list[str], options: argparse.Namespace) -> Iterator[Curve]:
    """What was played under each condition by itself, played first where it is missing."""
    from deploy.commands.stress import play_missing  # imports Ray, which `shoal train` configures first

    players = {kind: [names.index(run_name(method, kind, seed)) for seed in options.seeds] for kind in KINDS} | {
        name: [names.index(name)] for name in names if name in list(Baseline)
    }
    seeds = list(range(options.first_seed, options.first_seed + options.episodes))
    for axis in axes_of(options):
        targets = find_players(Stress(run=tuple(names), runs_dir=options.runs_dir))
        folder = options.runs_dir / "played"
        results = StressResults(folder, targets, [axis], grid([axis]), seeds)
        play_missing(results, seeds, None)
        for setup, name in enumerate(results.setups()):
            for player, members in players.items():
                goals = [
                    np.mean([results.goals(member, setup, value)[:, 0] for member in members], axis=0)
                    for value in range(len(axis.values))
                ]
                yield Curve(axis, name, player, np.array(goals))


def table(method: str, found: list[Curve], options: argparse.Namespace) -> Table:
    """Success under the conditions shown, and the paired difference to the clean policy without a condition."""
    clean = {curve.setup: curve.goals[0] for curve in found if curve.player == CLEAN}
    players = list(dict.fromkeys(curve.player for curve in found))
    title = f"{find(METHODS, method).label}: success in %, paired difference to {CLEAN} without conditions"
    result = Table(title=f"{title}; {len(options.seeds)} trainings, {options.episodes} episodes")
    for name in ("setup", "condition", *players):
        result.add_column(name, justify="left" if name in ("setup", "condition") else "right")
    shown = [condition for condition in SHOWN if condition[0] in options.conditions]
    for setup in clean:
        for number, (axis, value) in enumerate(shown):
            at = {curve.player: curve for curve in found if (curve.axis.name, curve.setup) == (axis, setup)}
            row = at[CLEAN].axis.values.index(value)
            texts = []
            for player in players:
                goals = at[player].goals[row]
                texts.append(f"{100 * goals.mean():.1f}: {signed_percent(mean(goals - clean[setup]))}")
            result.add_row("" if number else setup, f"{axis} {value}" if value else "none", *texts)
        result.add_section()
    return result


def breaks(method: str, found: list[Curve]) -> Table:
    """Where the mean over a player's trainings falls to 50 % along each axis."""
    players = list(dict.fromkeys(curve.player for curve in found))
    result = Table(title=f"{find(METHODS, method).label}: where success falls to 50 %")
    for name in ("setup", "condition", *players):
        result.add_column(name, justify="left" if name in ("setup", "condition") else "right")
    for setup in dict.fromkeys(curve.setup for curve in found):
        for axis in dict.fromkeys(curve.axis for curve in found):
            points = [
                breaking_point(axis.values, [rate.value for rate in curve.rates])
                for curve in found
                if (curve.axis, curve.setup) == (axis, setup)
            ]
            result.add_row(setup, axis.name, *("–" if point is None else f"{point:.3g}" for point in points))
        result.add_section()
    return result


def write(path: Path, method: str, found: list[Curve]) -> None:
    """Writes every point as CSV: the success rate with its interval, in shares."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["method", "setup", "condition", "value", "player", "episodes", "success", "low", "high"])
        for curve in found:
            for value, goals, rate in zip(curve.axis.values, curve.goals, curve.rates, strict=True):
                numbers = (f"{share:.4f}" for share in rate)
                writer.writerow([method, curve.setup, curve.axis.name, value, curve.player, len(goals), *numbers])


def main(arguments: list[str] | None = None) -> int:
    options, console = parse(arguments), Console(width=190)
    for method in options.methods:
        found = list(curves(method, train(method, options), options))
        console.print(table(method, found, options))
        console.print(breaks(method, found))
        everything = len(axes_of(options)) == len(AXES)
        path = options.runs_dir / (method if everything else f"{method}-{'-'.join(options.conditions)}")
        write(path.with_suffix(".csv"), method, found)
        panels = [
            Panel(
                f"{axis.name}, {setup}",
                axis.values,
                {c.player: c.rates for c in found if (c.axis, c.setup) == (axis, setup)},
            )
            for axis in axes_of(options)
            for setup in dict.fromkeys(curve.setup for curve in found)
        ]
        stress_curves_png(panels, path.with_suffix(".png"), f"{find(METHODS, method).label}: success under bad senses")
        print(path.with_suffix(".csv"), path.with_suffix(".png"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
