"""Exploration rates against their closed forms, and actions against their distributions."""

import numpy as np
import pytest
from scipy import stats

from actors.rollout.exploration import GREEDY, Exploration, draw_random_actions, epsilon
from actors.rollout.step_kernels import explore

SCHEDULE = Exploration("schedule", 1.0, 0.05, 1000, 0.4, 7.0)
LADDER = SCHEDULE._replace(kind="ladder")


@pytest.mark.parametrize(
    ("env_steps", "rate"), [(0, 1.0), (1, 0.99905), (500, 0.525), (999, 0.05095), (1000, 0.05), (10**9, 0.05)]
)
def test_the_schedule_is_linear_and_then_constant(env_steps, rate):
    assert epsilon(SCHEDULE, env_steps, 0, 1) == pytest.approx(rate, abs=1e-12)
    assert epsilon(SCHEDULE, env_steps, 3, 8) == epsilon(SCHEDULE, env_steps, 0, 1)


def test_the_schedule_may_rise():
    rising = SCHEDULE._replace(start=0.1, end=0.3)
    assert epsilon(rising, 250, 0, 1) == pytest.approx(0.15)


def test_the_ladder_is_that_of_ape_x():
    rates = [epsilon(LADDER, 12345, i, 8) for i in range(8)]
    expected = [0.4 ** (1 + 7 * i / 7) for i in range(8)]  # Horgan et al. 2018, alpha = 7, N = 8
    np.testing.assert_allclose(rates, expected, rtol=1e-12)
    assert rates[0] == pytest.approx(0.4) and rates[-1] == pytest.approx(0.4**8)


def test_the_ladder_is_constant_and_works_for_one_worker():
    assert epsilon(LADDER, 0, 2, 5) == epsilon(LADDER, 10**9, 2, 5)
    assert epsilon(LADDER, 0, 0, 1) == pytest.approx(0.4)


def test_rate_0_is_greedy_and_rate_1_is_uniform():
    rng = np.random.default_rng(1)
    greedy = np.full(60_000, 2)
    np.testing.assert_array_equal(explore(greedy, draw_random_actions((60_000,), 0.0, 5, rng)), greedy)
    counts = np.bincount(explore(greedy, draw_random_actions((60_000,), 1.0, 5, rng)), minlength=5)
    assert stats.chisquare(counts).pvalue > 1e-4


@pytest.mark.parametrize("rate", [0.05, 0.5])
def test_actions_are_random_at_the_exploration_rate(rate):
    greedy = np.random.default_rng(2).integers(4, size=60_000)
    chosen = explore(greedy, draw_random_actions((60_000,), rate, 4, np.random.default_rng(3)))
    changed = int((chosen != greedy).sum())
    # A random action equals the greedy one in a quarter of the cases. A wrong rule would change it at the full rate.
    assert stats.binomtest(changed, len(greedy), rate * 3 / 4).pvalue > 1e-4
    assert stats.binomtest(changed, len(greedy), rate).pvalue < 1e-4


def test_explore_does_not_change_its_argument_and_is_deterministic():
    greedy = np.zeros(50, np.int64)
    first, again = (explore(greedy, draw_random_actions((50,), 0.7, 3, np.random.default_rng(4))) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert not greedy.any() and first.any() and first.dtype == np.int64


def test_every_step_and_environment_has_its_own_draw():
    random_actions = draw_random_actions((40, 30), 0.5, 6, np.random.default_rng(5))
    explored = random_actions != GREEDY
    assert random_actions.shape == (40, 30)
    assert random_actions[explored].min() == 0 and random_actions[explored].max() == 5
    assert stats.chisquare(explored.sum(axis=0)).pvalue > 1e-4 and stats.chisquare(explored.sum(axis=1)).pvalue > 1e-4
    assert len({row.tobytes() for row in random_actions}) == 40
    assert len({row.tobytes() for row in random_actions.T}) == 30
