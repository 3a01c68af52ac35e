"""The shield in the worlds of preset `best`, 25 setups: success, and collisions per million robot steps.

A collision in spite of the shield is played again. The robot was squeezed if in the last simulator step the half-planes
of the robots that it sensed permitted no velocity. It was run into if nobody would have touched it, had all others kept
their velocities, as the half-planes assume. What is left are collisions that the half-planes could have avoided.

python -m tests.benchmarks.shield --methods in out --episodes 1000     # 100,000 episodes of the rule `greedy`
"""

import argparse
import dataclasses
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from actors.evaluation.evaluator import evaluate, record_episode
from actors.evaluation.result_table import GROUPS, ROBOTS
from actors.evaluation.statistics import as_percent, paired_comparison, rate
from actors.policy.baselines import Baseline
from actors.rollout.env_spec import EnvSpec
from learner.presets import preset_config
from sim_core import ENV_ID
from sim_core.outcomes import Outcome
from sim_core.shield import SPEED_MARGIN
from tests.sim_core.half_planes import Clearance, closest_permitted, half_planes

FIRST_SEED = 3_000_000_000
METHODS = ("in", "out", "sensor")
SHIELDS = ("none", "orca")


CAUSES = SQUEEZED, RUN_INTO, AVOIDABLE = ("squeezed", "run into", "avoidable")


class Played(NamedTuple):
    """Episodes of one setup: successes `[episodes]`, collisions, how they came with a shield, and steps in all."""

    goals: np.ndarray
    collisions: int
    causes: Counter[str]
    steps: int


def play(method: str, shield: str, robots: int, groups: int, episodes: int) -> Played:
    """Episodes of the rule `greedy`."""
    world = dataclasses.replace(preset_config("best", method, robots, groups).world, shield=shield)
    spec, seeds = EnvSpec(ENV_ID, world), list(range(FIRST_SEED, FIRST_SEED + episodes))
    stats = evaluate(spec, Baseline.GREEDY, seeds)
    collided = np.flatnonzero(stats.outcome == Outcome.COLLISION)
    causes = Counter(cause(spec, seeds[i]) for i in collided) if shield != SHIELDS[0] else Counter[str]()
    return Played(stats.outcome == Outcome.GOAL, len(collided), causes, int(stats.length_steps.sum()))


def cause(spec: EnvSpec, seed: int) -> str:
    """How the collision at an episode's end came: one of CAUSES."""
    episode, world = record_episode(spec, Baseline.GREEDY, seed), spec.world
    before = episode.position[-2] + episode.velocity[-2] * world.time_step_s
    before[episode.learner] = episode.position[-1, episode.learner]
    away = np.linalg.norm(before - before[episode.learner], axis=1)
    if (np.delete(away, episode.learner) > 2 * world.robot_radius_m).all():
        return RUN_INTO
    radius = world.robot_radius_m + world.shield_margin_m
    clearance = Clearance(radius, world.shield_horizon_s, world.outer_radius_m)
    lines = half_planes(episode.position[-2], episode.velocity[-2], episode.learner, clearance)
    top_speed = world.method_class.top_speed_m_s(world) * SPEED_MARGIN
    return SQUEEZED if closest_permitted(lines, top_speed, episode.asked[-2].astype(float)) is None else AVOIDABLE


def main(methods: Sequence[str] = METHODS, episodes: int = 40) -> None:
    """Prints a row for each method and shield, and the setup where the shield helps least."""
    setups = [(robots, groups) for robots in ROBOTS for groups in GROUPS]
    table = Table(title=f"rule greedy in the worlds of best, 25 setups of {episodes} episodes from seed {FIRST_SEED:,}")
    for name in (
        "method",
        "shield",
        "success",
        "collisions",
        *CAUSES,
        "per million robot steps",
        "least gained in a setup",
    ):
        table.add_column(name, justify="right")
    with ProcessPoolExecutor() as pool:
        for method in methods:
            found = {
                shield: list(pool.map(play, *zip(*((method, shield, *at, episodes) for at in setups), strict=True)))
                for shield in SHIELDS
            }
            for shield, played in found.items():
                goals, steps = np.concatenate([one.goals for one in played]), sum(one.steps for one in played)
                collisions, causes, gained = sum(one.collisions for one in played), [""] * len(CAUSES), ""
                if shield != SHIELDS[0]:
                    pairs = zip(found[SHIELDS[0]], played, setups, strict=True)
                    gains = [(paired_comparison(a.goals, b.goals).difference, at) for a, b, at in pairs]
                    causes = [str(sum(one.causes[name] for one in played)) for name in CAUSES]
                    least, (robots, groups) = min(gains)
                    low, high = 100 * least.low, 100 * least.high
                    gained = f"{100 * least.value:+.1f} points ({low:+.1f} … {high:+.1f}), {robots}r×{groups}g"
                share = as_percent(rate(int(goals.sum()), len(goals)))
                per_million = f"{1e6 * collisions / steps:.1f}"
                table.add_row(method, shield, share, str(collisions), *causes, per_million, gained)
            table.add_section()
    Console(width=155).print(table)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--episodes", type=int, default=40, help="episodes of each setup")
    main(**vars(parser.parse_args()))
