"""Figure 2.2: what is drawn is what the simulator's robots did."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from dashboards.figures.state_machine import STATES, counted_changes, diagram_2_2, recorded_states
from sim_core.config import WorldConfig
from sim_core.swarm.flock_rules import SINGLE_GROUP, STATE_NAMES, VISION_FREE

WORLD = WorldConfig(robots=4, groups=3)


@pytest.fixture(scope="module")
def states() -> np.ndarray:
    return recorded_states(WORLD, 3)


def test_changes_are_those_of_a_count_by_hand(states: np.ndarray):
    counts = counted_changes(states)
    for before in STATES:
        for after in STATES:
            pairs = [(a, b) for a, b in zip(states, states[1:], strict=False)]
            assert counts[before, after] == sum(int(((a == before) & (b == after)).sum()) for a, b in pairs)
    assert counts.sum() == (len(states) - 1) * WORLD.num_robots


def test_every_simulator_step_counts_however_long_a_decision_lasts(states: np.ndarray):
    slow = recorded_states(dataclasses.replace(WORLD, decision_interval_steps=4), 3)
    np.testing.assert_array_equal(slow, states)


def test_in_a_world_of_one_group_nobody_senses_another(states: np.ndarray):
    alone = recorded_states(WorldConfig(robots=4, groups=1), 3)
    assert not np.any(alone == VISION_FREE)
    assert np.any(states == VISION_FREE) and np.any(states == SINGLE_GROUP)


def test_the_figure_has_every_state_with_its_share(states: np.ndarray):
    (axes,) = diagram_2_2(WORLD, 3).axes
    texts = [text.get_text() for text in axes.texts]
    for state in STATES:
        share = 100 * float((states == state).mean())
        assert any(text.startswith(f"{STATE_NAMES[state].title()}  {share:.0f} %") for text in texts)
