"""`make league`: our policies, the rules, FL-ORCA and GA3C-CADRL drive the learning robot in the same start scenes.

GA3C-CADRL-10 (Everett, Chen and How, IROS 2018) is the published network of the package `gym-collision-avoidance`. It
gets its group's centre as its goal. Our policies are trainings of the preset `best`, one a setup. There are two worlds:
in that of M_sensor the swarm avoids the learning robot, in that of M_IN and M_OUT it does not.
"""

import argparse
import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from actors.evaluation.evaluator import Candidate, evaluate
from actors.evaluation.statistics import as_percent, mean, rate
from actors.policy.baselines import Baseline
from actors.rollout.env_spec import EnvSpec
from deploy.console.summary_tables import signed_percent
from deploy.runs.policy_lookup import find_policy
from sim_core import ENV_ID
from sim_core.config import WorldConfig
from sim_core.outcomes import Outcome
from tests.benchmarks.cadrl import method, reference
from tests.benchmarks.cadrl.network import SPEEDS
from tests.benchmarks.trainings import trained

CADRL = "GA3C-CADRL"
WORLDS = {"the swarm avoids the learning robot": ("sensor",), "the swarm does not avoid it": ("in", "out")}
"""Methods whose policies play in each world."""
FAILURES = (Outcome.LOST, Outcome.CAPTURED, Outcome.COLLISION, Outcome.TIMEOUT)


class Player(NamedTuple):
    """Who drives, and the world as its method sees it; start scenes depend on the seed and the setup alone."""

    name: str
    world: WorldConfig
    candidate: Candidate


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.league", description=__doc__)
    parser.add_argument("--cadrl", type=Path, metavar="FOLDER", help="that gym-collision-avoidance was installed to")
    parser.add_argument("--setups", nargs="+", default=["10x2", "10x4", "25x4"], metavar="ROBOTSxGROUPS")
    parser.add_argument("--seed", type=int, default=0, help="of the trainings")
    parser.add_argument("--episodes", type=int, default=1_000, help="per player and setup")
    parser.add_argument("--first-seed", type=int, default=2_000_000_000, help="of the episodes")
    parser.add_argument("--runs-dir", type=Path, default=Path("runs/league"), help="finished trainings are kept")
    return parser.parse_args(arguments)


def cadrl_world(world: WorldConfig) -> WorldConfig:
    """The same world for GA3C-CADRL."""
    cls = method.Driven if world.learner_is_known else method.DrivenInEllipse
    return dataclasses.replace(world, method=f"{method.__file__}:{cls.__name__}", sectors=len(SPEEDS))


def players(setup: str, methods: tuple[str, ...], has_cadrl: bool, options: argparse.Namespace) -> Iterator[Player]:
    """Our policies, the rules of the last method, `field` where a method has it, FL-ORCA, GA3C-CADRL."""
    robots, groups = setup.split("x")
    worlds = []
    for name in methods:
        settings = ["--preset", "best", "--method", name, "--robots", robots, "--groups", groups, "--engine", "process"]
        folder = trained(options.runs_dir, f"{name}-{setup}-{options.seed}", [*settings, "--seed", str(options.seed)])
        config = folder.config()
        worlds.append(config.world)
        yield Player(config.world.method_class.label, config.world, find_policy(folder, config))
    for rule in (Baseline.GREEDY, Baseline.FIELD):
        having = [world for world in worlds if rule in world.method_class.rules(world)]
        if having:
            yield Player(f"rule {rule}", having[-1], rule)
    yield Player("FL-ORCA", worlds[-1], Baseline.FL_ORCA)
    if has_cadrl:
        yield Player(CADRL, cadrl_world(worlds[-1]), Baseline.GREEDY)


def add_rows(result: Table, setup: str, field: list[Player], options: argparse.Namespace) -> None:
    """One row a player; differences are paired, of the same start scenes."""
    seeds = list(range(options.first_seed, options.first_seed + options.episodes))
    outcomes = {one.name: evaluate(EnvSpec(ENV_ID, one.world), one.candidate, seeds).outcome for one in field}
    reached = {name: found == Outcome.GOAL for name, found in outcomes.items()}
    for name, found in outcomes.items():
        rates = [f"{100 * np.mean(found == failure):.1f}" for failure in FAILURES]
        difference = ""
        if CADRL in outcomes and name != CADRL:
            difference = signed_percent(mean(reached[name].astype(float) - reached[CADRL]))
        result.add_row(setup, name, as_percent(rate(int(reached[name].sum()), len(seeds))), *rates, difference)
    result.add_section()


def has_cadrl(folder: Path | None, console: Console) -> bool:
    """Whether GA3C-CADRL can play; its network must then give what TensorFlow gave.

    Raises:
      RuntimeError: it does not.
    """
    if folder is None:
        console.print(f"{CADRL}: no --cadrl FOLDER with gym-collision-avoidance, left out")
        return False
    sys.path.append(str(folder.resolve()))
    difference = reference.largest_difference()
    console.print(f"{CADRL} in numpy: probabilities differ from TensorFlow's by at most {difference:.1e}")
    if difference > reference.TOLERANCE:
        raise RuntimeError(f"{CADRL} in numpy differs from what TensorFlow gave by {difference:.1e}")
    return True


def main(arguments: list[str] | None = None) -> int:
    options = parse(arguments)
    console = Console(width=140)
    takes_part = has_cadrl(options.cadrl, console)
    for title, methods in WORLDS.items():
        result = Table(title=f"{title}: {options.episodes} episodes each, rates in %")
        for name in ("setup", "player", "success", "lost", "captured", "collision", "timeout", f"less {CADRL}'s"):
            result.add_column(name, justify="left" if name in ("setup", "player") else "right")
        for setup in options.setups:
            field = list(players(setup, methods, takes_part, options))
            with threadpool_limits(1, "blas"):  # two threads on a busy machine take a hundred times as long
                add_rows(result, setup, field, options)
        console.print(result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
