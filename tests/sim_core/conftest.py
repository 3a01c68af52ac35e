"""Hand-made worlds for the tests of sim_core."""

from typing import NamedTuple

import numpy as np
import pytest

from sim_core.flock_rules import flock_params
from sim_core.flocking import preferred_velocities
from sim_core.neighbours import find_neighbours
from sim_core.state import empty_scratch, empty_state

REAL = np.float32


class Flock(NamedTuple):
    """What `preferred_velocities` says about one world: velocity `[num_robots, 2]` and a robot's notes."""

    velocity: np.ndarray
    states: np.ndarray
    flags: np.ndarray
    leaders: np.ndarray


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
    state, scratch = _make_state(config, pos, goals, vel, seed=seed), empty_scratch(config, REAL)
    for i in range(config.num_robots):
        scratch.counts[i] = find_neighbours(
            i,
            state.pos_x[0],
            state.pos_y[0],
            -1,
            REAL(config.neighbour_range_m) ** 2,
            scratch.neighbours[i],
            scratch.distances_sq,
        )
    preferred_velocities(
        0,
        state.pos_x[0],
        state.pos_y[0],
        state.vel_x[0],
        state.vel_y[0],
        state.goal_x[0],
        state.goal_y[0],
        scratch.neighbours,
        scratch.counts,
        scratch.flags,
        scratch.leaders,
        state.machine[0],
        scratch.pref_x,
        scratch.pref_y,
        state.rng,
        flock_params(config, REAL),
    )
    velocity = np.stack([scratch.pref_x, scratch.pref_y], axis=-1)
    return Flock(velocity, state.machine[0], scratch.flags, scratch.leaders)


@pytest.fixture(scope="session")
def make_state():
    """Function: one world's WorldState from pos `[num_robots, 2]`, goals `[groups, 2]`, vel, learner, seed."""
    return _make_state


@pytest.fixture(scope="session")
def make_flock():
    """Function: Flock of one world from config, pos `[num_robots, 2]`, goals `[groups, 2]`, vel, seed."""
    return _make_flock
