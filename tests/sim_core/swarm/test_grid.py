"""The grid makes the neighbour search faster and never changes its result: with and without are equal bit for bit."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_core.config import WorldConfig
from sim_core.lanes import LANES
from sim_core.pilot import Pilot
from sim_core.swarm import step
from sim_core.swarm import tile as tile_module
from sim_core.swarm.grid import ROW_SPAN_CELLS
from sim_core.worlds import WorldBatch
from tests.sim_core.kernels import cell_list, orca_step
from tests.sim_core.swarm.test_neighbours import brute_force

REAL = np.float32
SIZES = (1, 2, 7, 8, 9, 40, 203, 600)


def _clusters(n, rng):
    centres = rng.uniform(-10, 10, (1 + n // 40, 2))
    return centres[rng.integers(len(centres), size=n)] + rng.normal(0, 0.4, (n, 2))


def _line(n, rng):
    return np.stack([0.1 * rng.permutation(n), np.full(n, 0.3)], axis=1)


def _one_far_away(n, rng):
    pos = rng.uniform(-3, 3, (n, 2))
    pos[rng.integers(n)] = rng.choice([-1e4, 1e4], 2)
    return pos


def _coincident(n, rng):
    return rng.uniform(-2, 2, (1 + n // 3, 2))[rng.integers(1 + n // 3, size=n)]


def _lattice(n, rng):
    """Exact ties everywhere, robots at exactly the range's distance, and robots on the cells' edges."""
    side = math.isqrt(n) + 1
    return 0.25 * np.stack(np.divmod(rng.permutation(side * side)[:n], side), axis=1)


POSITIONS = {
    "uniform": lambda n, rng: rng.uniform(-0.25, 0.25, (n, 2)) * math.sqrt(n),
    "sparse": lambda n, rng: rng.uniform(-2, 2, (n, 2)) * math.sqrt(n),
    "clusters": _clusters,
    "one cell": lambda n, rng: rng.uniform(0.1, 0.3, (n, 2)),
    "one point": lambda n, rng: np.full((n, 2), 2.5),
    "line": _line,
    "upright line": lambda n, rng: _line(n, rng)[:, ::-1],
    "slanted line": lambda n, rng: _line(n, rng)[:, :1] * [1.0, -0.7],
    "one far away": _one_far_away,
    "coincident": _coincident,
    "lattice": _lattice,
    "far from the origin": lambda n, rng: rng.uniform(-2, 2, (n, 2)) + [30_000, -20_000],
}
SETTINGS = {
    "default": {},
    "few and near": {"range_m": 0.4, "max_neighbours": 3},
    "one": {"max_neighbours": 1},
    "many and far": {"range_m": 4.0, "max_neighbours": 40},
    "lattice's range": {"range_m": 0.75},
}


def assert_same_step(pos, vel, pref, **settings):
    """With and without the grid neighbours, their order, half-planes and velocities are equal; returns the step."""
    expected = orca_step(pos, vel, pref, **settings)
    found = orca_step(pos, vel, pref, use_grid=True, **settings)
    for one, other in zip(found.neighbours, expected.neighbours, strict=True):
        assert one.tolist() == other.tolist()
    for one, other in zip(found.planes, expected.planes, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(found.velocity, expected.velocity)
    return found


def moving(pos, rng):
    """(positions, velocities, preferred velocities) `[n, 2]` float32."""
    return (np.asarray(array, REAL) for array in (pos, rng.normal(0, 0.5, pos.shape), rng.normal(0, 0.7, pos.shape)))


@pytest.mark.parametrize("name", SETTINGS)
@pytest.mark.parametrize("kind", POSITIONS)
def test_a_step_with_the_grid_equals_one_without(kind, name):
    num_neighbours = 0
    for n in SIZES:
        rng = np.random.default_rng([n, len(kind), len(name)])
        scene = tuple(moving(POSITIONS[kind](n, rng), rng))
        for search_radius_m in (None, 0.0, 0.3):
            hidden = int(rng.integers(-1, n))
            result = assert_same_step(*scene, hidden=hidden, search_radius_m=search_radius_m, **SETTINGS[name])
            assert not any(hidden in found for found in result.neighbours)
            num_neighbours += sum(len(found) for found in result.neighbours)
    assert num_neighbours > 50


def test_float64_steps_are_equal_too():
    rng = np.random.default_rng(4)
    for n in SIZES:
        pos, vel, pref = rng.uniform(-3, 3, (n, 2)), rng.normal(0, 0.5, (n, 2)), rng.normal(0, 0.7, (n, 2))
        assert_same_step(pos, vel, pref, real=np.float64, search_radius_m=0.3)


points = st.tuples(st.integers(-12, 12), st.integers(-12, 12))


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    cells=st.lists(points, min_size=1, max_size=80),
    spacing_m=st.sampled_from([0.125, 0.25, 0.3, 0.75, 1.5, 100.0]),
    max_neighbours=st.integers(1, 12),
    range_m=st.sampled_from([0.5, 0.75, 1.5, 3.0]),
    search_radius_m=st.sampled_from([None, 0.0, 0.4]),
    hidden=st.integers(-1, 79),
)
def test_the_grid_orders_ties_by_index(cells, spacing_m, max_neighbours, range_m, search_radius_m, hidden):
    pos = np.array(cells, REAL) * REAL(spacing_m)
    zero = np.zeros_like(pos)
    hidden = min(hidden, len(pos) - 1)
    settings = {"range_m": range_m, "max_neighbours": max_neighbours, "hidden": hidden}
    lists = assert_same_step(pos, zero, zero, search_radius_m=search_radius_m, **settings).neighbours
    for robot, found in enumerate(lists):
        assert found.tolist() == brute_force(robot, pos, range_m, max_neighbours, hidden)


def assert_each_robot_is_in_one_cell(pos, tile):
    """`cell_starts` partitions the candidates; each robot is one of them, in its cell, sorted by index there."""
    n, grid = len(pos), tile.grid
    columns, bands = grid.shape
    starts = grid.cell_starts[: columns * bands + 1]
    assert starts[0] == 0 and starts[-1] == n and (np.diff(starts) >= 0).all()
    assert columns >= 1 and bands >= 1 and columns * bands < len(grid.cell_starts)
    slots = tile.candidate_slot[:n]
    assert sorted(slots) == list(range(n))
    np.testing.assert_array_equal(grid.rank[slots], np.arange(n))
    np.testing.assert_array_equal(grid.cell[slots], np.repeat(np.arange(columns * bands), np.diff(starts)))
    candidates = np.stack([tile.candidate_x[:n], tile.candidate_y[:n]], axis=1)
    np.testing.assert_array_equal(candidates, tile.pos_vel[slots, :2])
    same_cell = np.diff(grid.cell[slots]) == 0
    assert (np.diff(slots)[same_cell] > 0).all()


def assert_cells_contain_their_robots(pos, tile, cell_size_m):
    """Each robot lies in its cell, and cells are no smaller than `cell_size_m`."""
    low_x, low_y, per_m = tile.grid.frame
    columns, bands = tile.grid.shape
    assert per_m <= 1 / cell_size_m
    np.testing.assert_array_equal([low_x, low_y], pos.min(axis=0))
    column, band = ((pos.astype(np.float64) - [low_x, low_y]) * per_m).astype(int).T
    np.testing.assert_array_equal(
        tile.grid.cell, np.minimum(band, bands - 1) * columns + np.minimum(column, columns - 1)
    )


def assert_rows_are_compact_and_maximal(pos, tile, rows):
    """Each robot is in one lane of one row; a row stays in one band and a few cells, and does not end too early."""
    n, columns = len(pos), tile.grid.shape[0]
    slots = tile.row_slots[:rows]
    assert slots[slots != n].tolist() == tile.candidate_slot[:n].tolist()
    sizes = (slots != n).sum(axis=1)
    assert (sizes > 0).all() and ((slots != n) == (np.arange(LANES) < sizes[:, None])).all()
    first, last = tile.grid.cell[slots[:, 0]], tile.grid.cell[slots[np.arange(rows), sizes - 1]]
    assert (first // columns == last // columns).all() and (last - first <= ROW_SPAN_CELLS).all()
    can_go_on = (first[1:] // columns == first[:-1] // columns) & (first[1:] - first[:-1] <= ROW_SPAN_CELLS)
    assert (sizes[:-1][can_go_on] == LANES).all()


def assert_valid_cell_list(pos, cell_size_m):
    """All of the above; returns the number of cells and of rows."""
    pos = np.asarray(pos, REAL)
    tile, rows = cell_list(pos, cell_size_m)
    assert_each_robot_is_in_one_cell(pos, tile)
    assert_cells_contain_their_robots(pos, tile, cell_size_m)
    assert_rows_are_compact_and_maximal(pos, tile, rows)
    return int(np.prod(tile.grid.shape)), rows


@pytest.mark.parametrize("kind", POSITIONS)
def test_each_robot_is_in_one_cell_and_one_lane(kind):
    for n in SIZES:
        for cell_size_m in (0.05, 0.75, 50.0):
            assert_valid_cell_list(POSITIONS[kind](n, np.random.default_rng(n)), cell_size_m)


coordinates = st.one_of(
    st.floats(-1e4, 1e4, width=32), st.floats(-1, 1, width=32), st.integers(-5, 5).map(float), st.just(1e30)
)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(
    pos=st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=60),
    cell_size_m=st.sampled_from([1e-3, 0.2, 0.75, 10.0]),
)
def test_each_robot_is_in_one_cell_and_one_lane_at_any_position(pos, cell_size_m):
    assert_valid_cell_list(pos, cell_size_m)


def test_cells_of_a_dense_world_have_the_requested_size():
    pos = np.stack(np.divmod(np.arange(400), 20), axis=1) * 0.3
    cells, rows = assert_valid_cell_list(pos, 0.75)
    assert cells == (19 * 0.3 // 0.75 + 1) ** 2
    assert rows < 400 / LANES * 1.5


WORLDS = {
    "25r×8g": {"robots": 25, "groups": 8},
    "25r×8g, unknown learner": {"robots": 25, "groups": 8, "swarm_knows_learner": "no"},
    "17r×9g, uniform": {"robots": 17, "groups": 9, "flocking": "uniform"},
    "5r×3g, none, unknown learner": {"robots": 5, "groups": 3, "flocking": "none", "swarm_knows_learner": "no"},
}
NUM_WORLDS, STEPS = 3, 50


def reset_worlds(name, monkeypatch, use_grid):
    """A freshly reset batch with or without the grid, in an arena so small that the groups meet soon."""
    for module in (tile_module, step):
        monkeypatch.setattr(module, "GRID_FROM_ROBOTS", 1 if use_grid else 10**9)
    worlds = WorldBatch(WorldConfig(arena_radius_m=4.0, **WORLDS[name]), NUM_WORLDS)
    worlds.reset()
    return worlds


def record(worlds):
    """All results and states of 50 steps by name, `[STEPS, num_worlds, ...]`; the last world restarts once."""
    found = []
    for i in range(STEPS):
        if i == STEPS // 2:
            worlds.reset(np.arange(NUM_WORLDS) == NUM_WORLDS - 1)
        found.append(worlds.step(Pilot.FREE if i % 3 else np.full(NUM_WORLDS, i % 8))._asdict() | worlds.get_state())
    return {key: np.stack([one[key] for one in found]) for key in found[0]}


@pytest.mark.parametrize("name", WORLDS)
def test_worlds_with_the_grid_step_like_worlds_without(name, monkeypatch):
    with_grid, without = reset_worlds(name, monkeypatch, True), reset_worlds(name, monkeypatch, False)
    first, second = record(with_grid), record(without)
    assert with_grid.tile.grid.shape.all() and not without.tile.grid.shape.any()
    for key in first:
        np.testing.assert_array_equal(first[key], second[key], err_msg=key)
    assert np.abs(first["pos_x"][-1] - first["pos_x"][0]).max() > 1  # the robots did move
