"""`make shares`: what becomes of a swarm of which one robot, a quarter, half or all learn.

Policies are trained with the preset `best` and so many learning robots, in one process, and each is then played at
every share. Cells tell the share of the learning robots whose group reaches its goal; `all`, that of the worlds in
which every one of them does; `hit`, the share that ends in a collision. FL-ORCA and the method's rule play the same
worlds. `--goal` gives M_sensor sectors that face the goal (`sector_frame`), whose direction its state does not hold.
"""

import argparse
import dataclasses
import sys
import tempfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from actors.evaluation.evaluator import Candidate, evaluate
from actors.evaluation.statistics import mean
from actors.policy.baselines import Baseline
from actors.policy.policy import WeightsSnapshot
from actors.rollout.env_spec import EnvSpec
from learner.config import RunConfig
from learner.loop import TrainingLoop
from learner.presets import preset_config
from learner.tracking.journal import Journal
from learner.training.cluster import ProcessCluster
from learner.training.evaluation_summary import summarise
from sim_core import ENV_ID
from sim_core.config import ONE_LEARNER
from sim_core.outcomes import Outcome
from sim_core.plugins import DISSERTATION_METHODS
from tests.benchmarks.learners import SHARES
from tests.checkpointing import Silent

FIRST_SEED = 2_000_000_000


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.shares", description=__doc__)
    parser.add_argument("--methods", nargs="+", choices=DISSERTATION_METHODS, default=list(DISSERTATION_METHODS))
    parser.add_argument("--setups", nargs="+", default=["10x2", "10x4"], metavar="ROBOTSxGROUPS")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="of the trainings")
    parser.add_argument("--worlds", type=int, default=200, help="played by each player at each share")
    parser.add_argument("--goal", action="store_true", help="M_sensor's sectors face the goal")
    return parser.parse_args(arguments)


def config_of(method: str, setup: str, learners: str, seed: int, goal: bool) -> RunConfig:
    """The training."""
    robots, groups = map(int, setup.split("x"))
    world: dict[str, Any] = {"robots": robots, "groups": groups, "learners": learners}
    if goal and method == "sensor":
        world["sector_frame"] = "goal"
    base = preset_config("best", method)
    steps = base.total_env_steps
    changed: dict[str, Any] = {"eval_every_env_steps": 2 * steps, "checkpoint_every_env_steps": 2 * steps}
    if "sector_frame" in world:
        changed["random_turns"] = False
    config = dataclasses.replace(base.world, **world)
    return dataclasses.replace(base, world=config, engine="process", seed=seed, **changed)


def trained(config: RunConfig) -> WeightsSnapshot:
    """The policy of a training in this process."""
    with tempfile.TemporaryDirectory() as folder, closing(Journal(Path(folder) / "metrics.jsonl", 0)) as journal:
        cluster = ProcessCluster(config, 0)
        loop = TrainingLoop(config, cluster, journal, Path(folder) / "checkpoints", Silent(), bool)
        loop.run()
        weights = loop.newest_weights()
        cluster.close()
    return weights


def cells(players: list[Candidate], config: RunConfig, worlds: int) -> Iterator[str]:
    """What players, which may be the policies of several seeds, do at every share."""
    seeds = list(range(FIRST_SEED, FIRST_SEED + worlds))
    for learners in SHARES:
        world = dataclasses.replace(config.world, learners=learners)
        found = [summarise(evaluate(EnvSpec(ENV_ID, world), player, seeds)) for player in players]
        arrive = [100 * each.rates[Outcome.GOAL].value for each in found]
        collide = np.mean([100 * each.rates[Outcome.COLLISION].value for each in found])
        everybody = [100 * each.team.all_arrive.value for each in found if each.team is not None]
        text = f"{np.mean(arrive):.0f}" + (f" ± {np.std(arrive):.0f}" if len(arrive) > 1 else "")
        yield f"{text}; all {mean(np.array(everybody)).value:.0f}; hit {collide:.0f}" if everybody else text


def table(method: str, setup: str, options: argparse.Namespace) -> Table:
    """One row a player, one column a share that it is played at."""
    name = f"{method}{', sectors face the goal' if options.goal and method == 'sensor' else ''} {setup}"
    result = Table(title=f"{name}: % arrive (± over {len(options.seeds)} seeds); all arrive; end in a collision")
    for column in ("player", *(f"played at {share}" for share in SHARES)):
        result.add_column(column, justify="left" if column == "player" else "right")
    base = config_of(method, setup, ONE_LEARNER, 0, options.goal)
    for rule in (Baseline.FL_ORCA, Baseline.GREEDY):
        result.add_row(str(rule), *cells([rule], base, options.worlds))
    for learners in SHARES:
        configs = [config_of(method, setup, learners, seed, options.goal) for seed in options.seeds]
        result.add_row(f"trained at {learners}", *cells([trained(each) for each in configs], base, options.worlds))
    return result


def main(arguments: list[str] | None = None) -> int:
    options = parse(arguments)
    for method in options.methods:
        for setup in options.setups:
            Console(width=150).print(table(method, setup, options))
    return 0


if __name__ == "__main__":
    sys.exit(main())
