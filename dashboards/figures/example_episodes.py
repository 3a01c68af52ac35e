"""Figures 3.2 and 3.3 of the dissertation: a success among eight groups, a captured robot, and a lost one.

The worlds are those of the preset. A baseline drives the learning robot, so that the pictures need no trained policy
and are the same everywhere: `greedy`, or `random` for the lost robot, because `greedy` hardly ever loses its group. The
first episode with the wanted outcome is drawn, with seeds counted from 0.
"""

from __future__ import annotations

import functools

import numpy as np
from matplotlib.figure import Figure

from actors.evaluation.evaluator import Candidate, evaluate, record_episode
from actors.evaluation.trajectory import Episode
from actors.policy.baselines import Baseline
from actors.rollout.env_spec import EnvSpec
from dashboards.analysis.aggregate import Setup
from dashboards.figures.diagrams import Diagram
from dashboards.figures.film_strip import episode_strip
from dashboards.figures.style import MUTED, new_figure
from sim_core import ENV_ID
from sim_core.config import WorldConfig
from sim_core.outcomes import OUTCOME_NAMES, Outcome

SEARCHED = 2_000
"""Episodes that are searched for the wanted outcome."""
AT_ONCE = 250
FRAMES = 5


def find_episode(spec: EnvSpec, player: Candidate, outcome: Outcome, first_seed: int = 0) -> Episode | None:
    """The first of `SEARCHED` episodes of `player`, by seed, that ends in `outcome`; None if none does."""
    for begin in range(first_seed, first_seed + SEARCHED, AT_ONCE):
        seeds = list(range(begin, begin + AT_ONCE))
        found = np.flatnonzero(evaluate(spec, player, seeds).outcome == outcome)
        if len(found):
            seed, learner = divmod(int(found[0]), spec.world.num_learners)
            return record_episode(spec, player, seeds[seed], learner)
    return None


@functools.lru_cache(maxsize=32)  # reports of one preset in one process draw the same episodes
def first_episode(world: WorldConfig, rule: Baseline, outcome: Outcome) -> Episode | None:
    """The episode of `find_episode` in a world, played by a rule."""
    return find_episode(EnvSpec(ENV_ID, world), rule, outcome)


def draw_example(rule: Baseline, outcome: Outcome, world: WorldConfig) -> Figure:
    """Draws a strip of the first episode with the outcome, or says that there is none."""
    episode = first_episode(world, rule, outcome)
    if episode is not None:
        return episode_strip(episode, world, FRAMES, f"Driven by the rule `{rule}`.")
    figure = new_figure(9.0, 1.2, f"{world.setup}: {OUTCOME_NAMES[outcome]}")
    figure.text(0.01, 0.3, f"none in {SEARCHED:,} episodes of the rule `{rule}`", color=MUTED)
    return figure


EXAMPLES = tuple(
    Diagram(file, alt, "sensor", setup, functools.partial(draw_example, rule, outcome))
    for file, alt, setup, rule, outcome in (
        (
            "figure-3-2.png",
            "Figure 3.2: frames of an episode with eight groups",
            Setup(10, 8),
            Baseline.GREEDY,
            Outcome.GOAL,
        ),
        (
            "figure-3-3a.png",
            "Figure 3.3 (a): a learning robot that is captured",
            Setup(5, 4),
            Baseline.GREEDY,
            Outcome.CAPTURED,
        ),
        (
            "figure-3-3b.png",
            "Figure 3.3 (b): a learning robot that is lost",
            Setup(5, 4),
            Baseline.RANDOM,
            Outcome.LOST,
        ),
    )
)
