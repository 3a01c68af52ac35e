"""The shield in the worlds of preset `best`, 25 setups: success, and collisions per million robot steps.

python -m tests.benchmarks.shield --episodes 1000     # 100,000 episodes of each method's rule `greedy`
"""

import argparse
import dataclasses
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from actors.evaluation.evaluator import evaluate
from actors.evaluation.result_table import GROUPS, ROBOTS
from actors.evaluation.statistics import as_percent, paired_comparison, rate
from actors.policy.baselines import Baseline
from actors.rollout.env_spec import EnvSpec
from learner.presets import preset_config
from sim_core import ENV_ID
from sim_core.outcomes import Outcome

FIRST_SEED = 3_000_000_000
METHODS = ("in", "out", "sensor")
SHIELDS = ("none", "orca")


class Played(NamedTuple):
    """Episodes of one setup: successes `[episodes]`, collisions, and steps in all."""

    goals: np.ndarray
    collisions: int
    steps: int


def play(method: str, shield: str, robots: int, groups: int, episodes: int) -> Played:
    """Episodes of the rule `greedy`."""
    world = dataclasses.replace(preset_config("best", method, robots, groups).world, shield=shield)
    seeds = list(range(FIRST_SEED, FIRST_SEED + episodes))
    stats = evaluate(EnvSpec(ENV_ID, world), Baseline.GREEDY, seeds)
    collisions = int((stats.outcome == Outcome.COLLISION).sum())
    return Played(stats.outcome == Outcome.GOAL, collisions, int(stats.length_steps.sum()))


def main(episodes: int = 40) -> None:
    """Prints a row for each method and shield, and the setup where the shield helps least."""
    setups = [(robots, groups) for robots in ROBOTS for groups in GROUPS]
    table = Table(title=f"rule greedy in the worlds of best, 25 setups of {episodes} episodes from seed {FIRST_SEED:,}")
    for name in ("method", "shield", "success", "collisions", "per million robot steps", "least gained in a setup"):
        table.add_column(name, justify="right")
    with ProcessPoolExecutor() as pool:
        for method in METHODS:
            found = {
                shield: list(pool.map(play, *zip(*((method, shield, *at, episodes) for at in setups), strict=True)))
                for shield in SHIELDS
            }
            for shield, played in found.items():
                goals, steps = np.concatenate([one.goals for one in played]), sum(one.steps for one in played)
                collisions, gained = sum(one.collisions for one in played), ""
                if shield != SHIELDS[0]:
                    pairs = zip(found[SHIELDS[0]], played, setups, strict=True)
                    gains = [(paired_comparison(a.goals, b.goals).difference, at) for a, b, at in pairs]
                    least, (robots, groups) = min(gains)
                    low, high = 100 * least.low, 100 * least.high
                    gained = f"{100 * least.value:+.1f} points ({low:+.1f} … {high:+.1f}), {robots}r×{groups}g"
                share = as_percent(rate(int(goals.sum()), len(goals)))
                table.add_row(method, shield, share, str(collisions), f"{1e6 * collisions / steps:.1f}", gained)
            table.add_section()
    Console(width=150).print(table)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=40, help="episodes of each setup")
    main(parser.parse_args().episodes)
