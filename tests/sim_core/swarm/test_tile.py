"""Tiles: worlds that share a tile fill its vectors, and each world steps as it would alone."""

import numpy as np
import pytest

from sim_core.config import WorldConfig
from sim_core.lanes import LANES
from sim_core.swarm.tile import GRID_FROM_ROBOTS, world_tile, worlds_per_tile
from sim_core.worlds import WorldBatch


def test_a_tile_holds_the_fewest_worlds_that_fill_its_vectors():
    for size in range(1, GRID_FROM_ROBOTS):
        full = [worlds for worlds in range(1, LANES + 1) if worlds * size % LANES == 0]
        assert worlds_per_tile(size) == full[0]
    for size in range(GRID_FROM_ROBOTS, GRID_FROM_ROBOTS + 20):
        assert worlds_per_tile(size) == 1


@pytest.mark.parametrize("num_worlds", [1, 3, 9])
def test_each_robot_has_a_slot_and_the_last_slot_is_padding(num_worlds):
    for size in (2, 5, 7, 16, 250, GRID_FROM_ROBOTS + 3):
        config = WorldConfig(robots=size, groups=1, arena_radius_m=20.0)
        tile = world_tile(config, num_worlds, np.float32)
        robots = min(worlds_per_tile(size), num_worlds) * size
        rows, slots = len(tile.row_slots), len(tile.pos_vel)
        assert slots > robots and rows * LANES >= robots
        assert tile.row_slots.min() >= 0 and tile.row_slots.max() < slots
        assert np.isnan(tile.pos_vel[-1]).all()
        per_slot = "to_goal group candidate_x candidate_y candidate_slot flags leaders new_vx new_vy machine".split()
        assert {len(getattr(tile, name)) for name in per_slot} == {slots}
        assert len(tile.flockmates) == len(tile.neighbour_counts) == len(tile.flock_terms) == rows
        if size < GRID_FROM_ROBOTS:  # rows hold the robots in order
            assert tile.row_slots.ravel()[:robots].tolist() == list(range(robots)) and rows == -(-robots // LANES)
        else:  # in the worst case a row holds one robot
            assert rows == size


def batch(robots, groups, seeds):
    """A freshly reset batch with one world per seed."""
    worlds = WorldBatch(
        WorldConfig(robots=robots, groups=groups, arena_radius_m=4.0 if robots < 60 else 8.0), len(seeds)
    )
    worlds.seed(seeds)
    worlds.reset()
    return worlds


def states(worlds, steps):
    """The state arrays after every step, by name, `[steps, num_worlds, ...]`; FL-ORCA drives all robots."""
    found = []
    for _ in range(steps):
        worlds.swarm_step()
        found.append(worlds.get_state())
    return {name: np.stack([one[name] for one in found]) for name in found[0]}


@pytest.mark.parametrize("robots, groups", [(7, 1), (4, 3), (5, 8), (GRID_FROM_ROBOTS // 4 + 1, 4)])
def test_worlds_in_a_batch_equal_worlds_alone(robots, groups):
    """Eight, two and one world per tile, and the grid. test_world_properties has more batches."""
    seeds = list(range(9))
    alone = [states(batch(robots, groups, [seed]), 12) for seed in seeds]
    for num_worlds in (1, 2, 8, 9) if robots < 60 else (3,):
        together = states(batch(robots, groups, seeds[:num_worlds]), 12)
        for i in range(num_worlds):
            for name, values in together.items():
                np.testing.assert_array_equal(values[:, i], alone[i][name][:, 0], err_msg=name)
