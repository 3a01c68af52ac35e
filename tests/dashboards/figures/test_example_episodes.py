"""Figures 3.2 and 3.3: the drawn episodes are the first with their outcome."""

from __future__ import annotations

import numpy as np
import pytest

from actors.evaluation.evaluator import evaluate
from actors.policy.baselines import Baseline
from actors.rollout.env_spec import EnvSpec
from dashboards.figures import example_episodes
from dashboards.figures.diagrams import Diagram
from dashboards.figures.example_episodes import EXAMPLES, draw_example, first_episode
from learner.presets import preset_config
from sim_core import ENV_ID
from sim_core.config import WorldConfig
from sim_core.outcomes import Outcome

ENDS = ((Baseline.GREEDY, Outcome.GOAL), (Baseline.GREEDY, Outcome.CAPTURED), (Baseline.RANDOM, Outcome.LOST))


@pytest.mark.parametrize(("example", "end"), list(zip(EXAMPLES, ENDS, strict=True)))
def test_the_first_episode_with_the_outcome_is_drawn(example: Diagram, end: tuple[Baseline, Outcome]):
    rule, outcome = end
    world = preset_config("thesis", example.method, *example.setup).world
    episode = first_episode(world, rule, outcome)
    assert episode is not None and episode.outcome == outcome
    ends = evaluate(EnvSpec(ENV_ID, world), rule, list(range(episode.seed + 1))).outcome
    assert ends[-1] == outcome and not np.any(ends[:-1] == outcome)
    texts = [text.get_text() for text in example.draw(world).texts]
    assert any(outcome.name.lower() in text for text in texts) and any(f"`{rule}`" in text for text in texts)


def test_a_missing_outcome_is_stated_in_the_picture(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(example_episodes, "SEARCHED", 250)
    figure = draw_example(Baseline.GREEDY, Outcome.CAPTURED, WorldConfig(robots=5, groups=1))  # there is no other group
    assert any("none in 250 episodes" in text.get_text() for text in figure.texts)
