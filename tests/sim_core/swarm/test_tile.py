"""Tiles: worlds side by side fill vectors, and each world steps as it would alone."""

import numpy as np
import pytest

from sim_core.config import WorldConfig
from sim_core.lanes import LANES
from sim_core.swarm.tile import GRID_FROM_ROBOTS, world_tile, worlds_per_tile
from sim_core.worlds import WorldBatch


def test_a_tile_is_the_fewest_worlds_that_fill_vectors():
    for size in range(1, GRID_FROM_ROBOTS):
        full = [worlds for worlds in range(1, LANES + 1) if worlds * size % LANES == 0]
        assert worlds_per_tile(size) == full[0]
    for size in range(GRID_FROM_ROBOTS, GRID_FROM_ROBOTS + 20):
        assert worlds_per_tile(size) == 1


@pytest.mark.parametrize("num_worlds", [1, 3, 9])
def test_everybody_has_a_slot_and_the_last_one_is_nobodys(num_worlds):
    for size in (2, 5, 7, 16, 250, GRID_FROM_ROBOTS + 3):
        config = WorldConfig(robots=size, groups=1, arena_radius_m=20.0)
        made = world_tile(config, num_worlds, np.float32)
        most = min(worlds_per_tile(size), num_worlds) * size
        rows, slots = len(made.order), len(made.body)
        assert slots > most and rows * LANES >= most
        assert made.order.min() >= 0 and made.order.max() < slots
        assert np.isnan(made.body[-1]).all()
        per_slot = "aim group seen_x seen_y seen_slot flags leaders new_vx new_vy machine".split()
        assert {len(getattr(made, name)) for name in per_slot} == {slots}
        assert len(made.mates) == len(made.counts) == len(made.terms) == rows
        if size < GRID_FROM_ROBOTS:  # robots stand in order, row after row
            assert made.order.ravel()[:most].tolist() == list(range(most)) and rows == -(-most // LANES)
        else:  # a row may hold one robot only
            assert rows == size


def batch(robots, groups, seeds):
    """A freshly reset batch of one world a seed."""
    worlds = WorldBatch(
        WorldConfig(robots=robots, groups=groups, arena_radius_m=4.0 if robots < 60 else 8.0), len(seeds)
    )
    worlds.seed(seeds)
    worlds.reset()
    return worlds


def states(worlds, steps):
    """The arrays of every step, by name, `[steps, num_worlds, ...]`; FL-ORCA drives everybody."""
    found = []
    for _ in range(steps):
        worlds.swarm_step()
        found.append(worlds.get_state())
    return {name: np.stack([one[name] for one in found]) for name in found[0]}


@pytest.mark.parametrize("robots, groups", [(7, 1), (4, 3), (5, 8), (GRID_FROM_ROBOTS // 4 + 1, 4)])
def test_worlds_of_other_sizes_too_equal_single_ones(robots, groups):
    """Eight, two and one world a tile, and the grid; more batches: test_world_properties."""
    seeds = list(range(9))
    alone = [states(batch(robots, groups, [seed]), 12) for seed in seeds]
    for num_worlds in (1, 2, 8, 9) if robots < 60 else (3,):
        together = states(batch(robots, groups, seeds[:num_worlds]), 12)
        for i in range(num_worlds):
            for name, values in together.items():
                np.testing.assert_array_equal(values[:, i], alone[i][name][:, 0], err_msg=name)
