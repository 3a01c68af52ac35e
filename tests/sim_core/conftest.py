"""Fixtures that make worlds by hand for the tests of sim_core."""

import numpy as np
import pytest

from sim_core.state import empty_state
from sim_core.swarm.step import swarm_params
from tests.sim_core.kernels import flock_of

REAL = np.float32


def _make_state(config, pos, goals, vel=None, learner=0, seed=0):
    state = empty_state(config, 1, REAL)
    state.pos_x[0], state.pos_y[0] = np.transpose(pos)
    state.goal_x[0], state.goal_y[0] = np.transpose(goals)
    if vel is not None:
        state.vel_x[0], state.vel_y[0] = np.transpose(vel)
    state.learner[0] = learner
    state.rng[0] = seed
    return state


def _make_flock(config, pos, goals, vel=None, seed=0):
    return flock_of(pos, vel, goals, seed, swarm_params(config, REAL))


@pytest.fixture(scope="session")
def make_state():
    """A function: WorldState of a world from config, pos `[num_robots, 2]`, goals `[groups, 2]`, vel, learner, seed."""
    return _make_state


@pytest.fixture(scope="session")
def make_flock():
    """A function: Flock of a world from config, pos `[num_robots, 2]`, goals `[groups, 2]`, vel, seed."""
    return _make_flock
