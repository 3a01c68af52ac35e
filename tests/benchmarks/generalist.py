"""`make generalist`: one policy for all setups beside the rules, on the same start scenes.

For every method, trainings of the preset `generalist` with several seeds. Each policy plays every setup of the
dissertation and some that no training has seen. The rules play the same episodes. The better rule of a setup is the one
that won most of these very episodes, so chance favours the rules.
"""

import argparse
import csv
import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from actors.evaluation.evaluator import Candidate
from actors.evaluation.statistics import Estimate, mean
from actors.policy.baselines import Baseline, exists
from actors.rollout.env_spec import EnvSpec
from actors.service.messages import EpisodeStats
from deploy.console.summary_tables import signed_percent
from deploy.runs.policy_lookup import find_policy
from learner.presets import preset_config
from learner.run_folder import RunFolder
from learner.tracking.journal import read_rows
from sim_core import ENV_ID
from sim_core.config import WorldConfig
from sim_core.outcomes import ENDED, OUTCOME_NAMES, Outcome
from tests.benchmarks.trainings import study_parser, trained

UNSEEN = ((7, 3), (12, 5), (30, 2), (3, 6))
"""Robots per group and groups that no training plays."""
RULES = (Baseline.FL_ORCA, Baseline.GREEDY, Baseline.FIELD)


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = study_parser("tests.benchmarks.generalist", __doc__, 1_000, Path("runs/generalist"))
    parser.add_argument("--out", type=Path, help="a CSV file for all counts")
    return parser.parse_args(arguments)


class Played(NamedTuple):
    """What one player did in one setup."""

    method: str
    world: WorldConfig
    player: str
    stats: EpisodeStats

    @property
    def goal(self) -> NDArray[np.bool_]:
        return self.stats.outcome == int(Outcome.GOAL)

    def rate(self, *outcomes: Outcome) -> float:
        return float(np.isin(self.stats.outcome, outcomes).mean())


def results(method: str, options: argparse.Namespace) -> Iterator[list[Played]]:
    """What the players did, setup after setup; the rules first."""
    settings = ["--preset", "generalist", "--method", method]
    folders = [
        trained(options.runs_dir, f"{method}-{seed}", [*settings, "--seed", str(seed), *options.train])
        for seed in options.seeds
    ]
    base = folders[0].config()
    unseen = [dataclasses.replace(base.world, robots=robots, groups=groups) for robots, groups in UNSEEN]
    worlds = [*base.env.worlds, *unseen]
    players: dict[str, Candidate] = {str(rule): rule for rule in RULES if exists(rule, base.world)}
    for seed, folder in zip(options.seeds, folders, strict=True):
        players[f"seed {seed}"] = find_policy(folder, folder.config())
    from learner.ray_backend.cluster import evaluate_in_tasks  # imports Ray, which `shoal train` configures first

    specs = [EnvSpec(ENV_ID, world) for world in worlds]
    seeds = list(range(options.first_seed, options.first_seed + options.episodes))
    stats = {name: evaluate_in_tasks(specs, player, seeds, None) for name, player in players.items()}
    for i, world in enumerate(worlds):
        yield [Played(method, world, name, found[i]) for name, found in stats.items()]


class Row(NamedTuple):
    """A setup: its better rule, the success rates of rule and policies, and the paired difference."""

    setup: str
    rule: str
    rule_rate: float
    rates: list[float]
    difference: Estimate
    lost: float

    @property
    def verdict(self) -> str:
        if self.difference.high < 0:
            return "below"
        return "above" if self.difference.low > 0 else "not below"


def compared(players: list[Played]) -> Row:
    """The row of one setup: the difference is that of an episode's mean over the trainings and the rule's result."""
    rules = [played for played in players if played.player in list(Baseline)]
    policies = [played for played in players if played.player not in list(Baseline)]
    better = max(rules, key=lambda played: played.goal.sum())
    difference = np.mean([played.goal for played in policies], axis=0) - better.goal
    return Row(
        players[0].world.setup,
        better.player,
        better.rate(Outcome.GOAL),
        [played.rate(Outcome.GOAL) for played in policies],
        mean(difference),
        float(np.mean([played.rate(Outcome.LOST, Outcome.CAPTURED) for played in policies])),
    )


def table(method: str, rows: list[Row], seen: int, options: argparse.Namespace) -> Table:
    known = rows[:seen]
    count = sum(row.verdict != "below" for row in known)
    learned = 100 * float(np.mean([row.rates for row in known]))
    ruled = 100 * float(np.mean([row.rule_rate for row in known]))
    lost = 100 * float(np.mean([row.lost for row in known]))
    found = Table(
        title=f"{method}: one policy for all setups, {len(options.seeds)} trainings, {options.episodes} episodes each",
        caption=f"mean {learned:.1f} %, the better rules {ruled:.1f} %; not below the better rule in {count} of "
        f"{seen} setups; lost or captured {lost:.2f} %",
    )
    for name in ("setup", "better rule", "its success", "learned (lowest … highest)", "difference, paired", "verdict"):
        found.add_column(name, justify="left" if name in ("setup", "better rule", "verdict") else "right")
    for i, row in enumerate(rows):
        low, middle, high = (100 * value for value in (min(row.rates), float(np.mean(row.rates)), max(row.rates)))
        found.add_row(
            row.setup + (" (unseen)" if i >= seen else ""),
            row.rule,
            f"{100 * row.rule_rate:.1f} %",
            f"{middle:.1f} % ({low:.1f} … {high:.1f})",
            signed_percent(row.difference),
            row.verdict,
        )
    return found


def wandering(method: str, options: argparse.Namespace) -> str:
    """A sentence on how much each training's policy still changes: its evaluations in the last half."""
    found = []
    for seed in options.seeds:
        folder = RunFolder(options.runs_dir / f"{method}-{seed}")
        half = folder.config().total_env_steps / 2
        rates = [row.metrics.get("eval/success_rate") for row in read_rows(folder.journal) if row.env_steps >= half]
        found.append(np.std([rate for rate in rates if rate is not None], ddof=1))
    return "evaluations in the last half of a training, standard deviation in points: " + ", ".join(
        f"{100 * deviation:.2f}" for deviation in found
    )


def write(path: Path, played: list[Played]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["method", "robots", "groups", "player", "episodes", *(OUTCOME_NAMES[o] for o in ENDED)])
        for each in played:
            counts = [int((each.stats.outcome == outcome).sum()) for outcome in ENDED]
            row = [each.method, each.world.robots, each.world.groups, each.player, len(each.stats.outcome)]
            writer.writerow([*row, *counts])


def main() -> int:
    options, everything = parse(), list[Played]()
    for method in options.methods:
        by_setup = list(results(method, options))
        everything += [each for players in by_setup for each in players]
        if options.out is not None:
            write(options.out, everything)
        rows = [compared(players) for players in by_setup]
        seen = len(preset_config("generalist", method).env.worlds)
        Console(width=140).print(table(method, rows, seen, options))
        print(wandering(method, options))
    return 0


if __name__ == "__main__":
    sys.exit(main())
