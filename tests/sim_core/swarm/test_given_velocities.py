"""Where several robots learn, FL-ORCA's velocities of those that get commands are left out, and nothing else."""

import numpy as np
import pytest

from sim_core.config import WorldConfig
from sim_core.jit import kernel
from sim_core.lanes import LANES
from sim_core.swarm.step import compute_velocities, load_tile, mark_given
from sim_core.worlds import WorldBatch

WORLDS = 4  # of ten robots: one tile of five vectors


@kernel
def _velocities(state, mask, running, tile, some_given, params):
    p = params[0]
    rows = load_tile(0, WORLDS, state, running, tile, p)
    if some_given:
        mark_given(0, WORLDS, state, mask, running, tile, p)
    compute_velocities(0, WORLDS * p.num_robots, rows, tile, state.rng, some_given, p)


@pytest.mark.parametrize("knows", ["yes", "no"])
def test_only_vectors_of_given_velocities_are_left_out(knows):
    config = WorldConfig(robots=5, groups=2, arena_radius_m=1.6, learners="1.0", swarm_knows_learner=knows)
    worlds = WorldBatch(config, WORLDS)
    worlds.reset()
    rng, found = np.random.default_rng(0), []
    for _ in range(12):
        worlds.step(rng.integers(config.num_actions, size=worlds.num_rows))
    mask, running = np.array([True, True, False, True]), np.ones(worlds.num_rows, np.bool_)
    running[:3] = False
    lists = worlds.tile.neighbours.copy()
    for some_given in (False, True):
        tile = worlds.tile
        tile.neighbours[:], tile.new_vx[:], tile.new_vy[:] = lists, 77.0, 77.0
        _velocities(worlds.state, mask, running, tile, some_given, worlds.swarm)
        found.append(np.stack([tile.new_vx, tile.new_vy, tile.machine])[:, : WORLDS * 10].copy())
    given = np.zeros((WORLDS, 10), bool)
    given[2] = True  # a world that does not move
    for row in np.flatnonzero(running):
        given[row // config.num_learners, worlds.state.learner[row]] = True
    whole, skipping = found
    given = given.reshape(-1)
    np.testing.assert_array_equal(skipping[:, ~given], whole[:, ~given])
    np.testing.assert_array_equal(skipping[2], whole[2])  # the state machine is that of all robots
    left_out = given.reshape(-1, LANES).all(axis=1).repeat(LANES)
    assert left_out.any() and (skipping[:2, left_out] == 77.0).all() and (whole[:2] != 77.0).all()
