"""Scenarios: geometry, uniformity (scipy) and the 25 setups of the dissertation."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.distance import pdist

from sim_core.config import WorldConfig
from sim_core.worlds import WorldBatch
from tests.sim_core.segregation import segregated_fraction

SETUPS = list(itertools.product((5, 10, 15, 20, 25), (1, 2, 3, 4, 8)))
WORLDS = 40


def start(num_worlds=WORLDS, **settings):
    """A freshly reset batch."""
    worlds = WorldBatch(WorldConfig(**settings), num_worlds)
    worlds.seed(list(range(100, 100 + num_worlds)))
    worlds.reset()
    return worlds


def grid_coordinates(worlds):
    """Start positions `[num_worlds, groups, robots, 2]` along and across the line from the goal to the group centre."""
    config, goals = worlds.config, worlds.goals().astype(np.float64)
    along = -goals / config.arena_radius_m
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    pos = worlds.positions().astype(np.float64).reshape(worlds.num_worlds, config.groups, config.robots, 2)
    delta = pos + goals[:, :, None]  # the group centre is the goal's antipode
    return np.stack([(delta * along[:, :, None]).sum(-1), (delta * across[:, :, None]).sum(-1)], axis=-1)


@pytest.mark.parametrize(("robots", "groups"), SETUPS)
def test_setups_of_the_dissertation_start_segregated_and_without_collisions(robots, groups):
    worlds = start(robots=robots, groups=groups)
    assert min(pdist(pos).min() for pos in worlds.positions()) > 2 * worlds.config.robot_radius_m
    assert (segregated_fraction(worlds.positions(), groups) == 1).all()
    assert not worlds.state.vel_x.any() and not worlds.state.vel_y.any()
    assert ((worlds.state.learner >= 0) & (worlds.state.learner < robots * groups)).all()


@pytest.mark.parametrize(("robots", "groups"), [(5, 3), (10, 2), (25, 8)])
def test_goals_lie_evenly_on_the_circle_opposite_the_group_centres(robots, groups):
    worlds = start(robots=robots, groups=groups)
    goals = worlds.goals().astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(goals, axis=-1), worlds.config.arena_radius_m, rtol=1e-6)
    turn = np.angle(goals[..., 0] + 1j * goals[..., 1])
    np.testing.assert_allclose(np.cos(np.diff(turn, axis=1) - 2 * np.pi / groups), 1, atol=1e-6)
    centres = worlds.positions().reshape(WORLDS, groups, robots, 2).mean(axis=2)
    assert np.abs(centres + goals).max() < worlds.config.start_spacing_m


@pytest.mark.parametrize("robots", [2, 5, 9, 10, 25])
def test_without_jitter_the_start_is_a_square_grid(robots):
    worlds = start(robots=robots, groups=2, start_jitter_m=0.0, start_spacing_m=0.5)
    grid = grid_coordinates(worlds)
    np.testing.assert_allclose(grid, np.broadcast_to(grid[:1, :1], grid.shape), atol=2e-6)
    np.testing.assert_allclose(pdist(grid[0, 0]).min(), 0.5, atol=2e-6)
    steps = (grid[0, 0] - grid[0, 0].min(axis=0)) / 0.5
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-5)
    columns = math.ceil(math.sqrt(robots))
    assert steps.max(axis=0).round().tolist() == [math.ceil(robots / columns) - 1, columns - 1]
    np.testing.assert_allclose(grid[0, 0].max(axis=0), -grid[0, 0].min(axis=0), atol=2e-6)  # centred


def test_jitter_is_uniform_on_both_axes():
    settings = {"robots": 25, "groups": 4}
    plain = grid_coordinates(start(start_jitter_m=0.0, **settings))
    jitter = grid_coordinates(start(start_jitter_m=0.1, **settings)) - plain[:1]
    assert np.abs(jitter).max() <= 0.1 + 2e-6
    for axis in range(2):
        values = jitter[..., axis].ravel()
        assert stats.kstest(values, stats.uniform(-0.1, 0.2).cdf).pvalue > 1e-3
    assert abs(np.corrcoef(jitter.reshape(-1, 2).T)[0, 1]) < 0.06


def test_rotation_and_learning_robot_are_uniform_and_independent():
    worlds = start(num_worlds=4000, robots=5, groups=3)
    goals, learner = worlds.goals()[:, 0], worlds.state.learner
    turn = (np.angle(goals[:, 0] + 1j * goals[:, 1]) + np.pi) / (2 * np.pi)
    assert stats.kstest(turn, "uniform").pvalue > 1e-3
    assert stats.chisquare(np.bincount(learner, minlength=15)).pvalue > 1e-3
    table = np.histogram2d(learner, turn, bins=[15, 4])[0]
    assert stats.chi2_contingency(table).pvalue > 1e-3


def test_episodes_of_a_world_differ_and_the_mask_selects_the_worlds_that_restart():
    worlds = start(num_worlds=3, robots=5, groups=2)
    for _ in range(3):
        worlds.step(np.zeros(3, np.int64))
    before = worlds.get_state()
    worlds.reset(np.array([False, True, False]))
    after = worlds.get_state()
    for name in before:
        np.testing.assert_array_equal(after[name][[0, 2]], before[name][[0, 2]], err_msg=name)
    assert after["steps"].tolist() == [3, 0, 3]
    assert after["episode_return"][1] == 0 and not after["machine"][1].any()
    assert np.abs(after["goal_x"][1] - before["goal_x"][1]).min() > 1e-3
    learner = after["learner"][1]
    delta = worlds.positions()[1, learner] - worlds.goals()[1, learner // 5]
    assert after["goal_distance_m"][1] == pytest.approx(np.linalg.norm(delta), rel=1e-6)
