"""What driving like a unicycle costs the rules and FL-ORCA, in the worlds of preset `best`, 25 setups.

python -m tests.benchmarks.unicycle --episodes 40     # 1,000 episodes a cell
"""

import argparse
import dataclasses
import functools
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from rich.console import Console
from rich.table import Table

from actors.evaluation.evaluator import evaluate
from actors.evaluation.result_table import GROUPS, ROBOTS
from actors.evaluation.statistics import as_percent, paired_comparison, rate
from actors.policy.baselines import Baseline
from actors.rollout.vector_env import EnvSpec
from deploy.console.summary_tables import signed_percent
from learner.presets import preset_config
from sim_core import ENV_ID
from sim_core.outcomes import Outcome

FIRST_SEED = 3_000_000_000
METHODS = ("sensor", "in", "out")
PLAYERS = (Baseline.GREEDY, Baseline.FL_ORCA)
LIMITS = ((360.0, 4.0), (180.0, 2.0), (90.0, 1.0))
"""Turn rate, degrees a second, and acceleration, m/s^2."""
SETUPS = [(robots, groups) for robots in ROBOTS for groups in GROUPS]


def outcomes(
    method: str, player: Baseline, limits: tuple[float, float] | None, episodes: int, setup: tuple[int, int]
) -> np.ndarray:
    """Outcomes `[episodes]` in a setup; without limits, of the holonomic robot."""
    world = preset_config("best", method, *setup).world
    if limits is not None:
        turn, acceleration = limits
        world = dataclasses.replace(
            world, kinematics="unicycle", turn_rate_limit_deg_s=turn, acceleration_limit_m_s2=acceleration
        )
    seeds = list(range(FIRST_SEED, FIRST_SEED + episodes))
    return evaluate(EnvSpec(ENV_ID, world), player, seeds).outcome


def main(episodes: int = 8) -> None:
    """Prints a row for each method and who drives: success without limits, and with them, paired."""
    table = Table(title=f"success in the worlds of best, 25 setups of {episodes} episodes from seed {FIRST_SEED:,}")
    limited = [f"{turn:.0f}°/s, {a:.0f} m/s²" for turn, a in LIMITS]
    for name in ("method", "drives", "holonomic", *limited, f"collide at {limited[-1]}"):
        table.add_column(name, justify="right")
    with ProcessPoolExecutor() as pool:
        for method in METHODS:
            for player in PLAYERS:
                played = [
                    np.concatenate(
                        list(pool.map(functools.partial(outcomes, method, player, limits, episodes), SETUPS))
                    )
                    for limits in (None, *LIMITS)
                ]
                goals = [found == Outcome.GOAL for found in played]
                cells = [as_percent(rate(int(goals[0].sum()), len(goals[0])))]
                for reached in goals[1:]:
                    difference = signed_percent(paired_comparison(goals[0], reached).difference)
                    cells.append(f"{100 * reached.mean():.1f} %: {difference}")
                collided = int((played[-1] == Outcome.COLLISION).sum())
                table.add_row(method, str(player), *cells, as_percent(rate(collided, len(played[-1]))))
            table.add_section()
    Console(width=170).print(table)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=8, help="episodes of each setup")
    main(parser.parse_args().episodes)
