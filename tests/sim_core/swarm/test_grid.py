"""The grid changes how far a search has to look, never what it finds: equal results with and without, bit for bit."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_core.config import WorldConfig
from sim_core.lanes import LANES
from sim_core.swarm import step, tile
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
    """Exact ties everywhere, robots exactly as far as the range, and on the cells' edges."""
    side = math.isqrt(n) + 1
    return 0.25 * np.stack(np.divmod(rng.permutation(side * side)[:n], side), axis=1)


PLACES = {
    "uniform": lambda n, rng: rng.uniform(-0.25, 0.25, (n, 2)) * math.sqrt(n),
    "sparse": lambda n, rng: rng.uniform(-2, 2, (n, 2)) * math.sqrt(n),
    "clusters": _clusters,
    "one cell": lambda n, rng: rng.uniform(0.1, 0.3, (n, 2)),
    "one place": lambda n, rng: np.full((n, 2), 2.5),
    "line": _line,
    "upright line": lambda n, rng: _line(n, rng)[:, ::-1],
    "slanted line": lambda n, rng: _line(n, rng)[:, :1] * [1.0, -0.7],
    "one far away": _one_far_away,
    "coincident": _coincident,
    "lattice": _lattice,
    "far from the origin": lambda n, rng: rng.uniform(-2, 2, (n, 2)) + [30_000, -20_000],
}
SETTINGS = {
    "the worlds' own": {},
    "few and near": {"range_m": 0.4, "max_neighbours": 3},
    "one": {"max_neighbours": 1},
    "many and far": {"range_m": 4.0, "max_neighbours": 40},
    "lattice's range": {"range_m": 0.75},
}


def assert_same_step(pos, vel, pref, **settings):
    """Neighbours, in their order, half-planes and velocities with the grid are those without; returns them."""
    expected = orca_step(pos, vel, pref, **settings)
    found = orca_step(pos, vel, pref, grid=True, **settings)
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
@pytest.mark.parametrize("kind", PLACES)
def test_a_step_by_grid_equals_one_without(kind, name):
    listed = 0
    for n in SIZES:
        rng = np.random.default_rng([n, len(kind), len(name)])
        scene = tuple(moving(PLACES[kind](n, rng), rng))
        for reach_m in (None, 0.0, 0.3):
            hidden = int(rng.integers(-1, n))
            result = assert_same_step(*scene, hidden=hidden, reach_m=reach_m, **SETTINGS[name])
            assert not any(hidden in found for found in result.neighbours)
            listed += sum(len(found) for found in result.neighbours)
    assert listed > 50


def test_float64_worlds_too():
    rng = np.random.default_rng(4)
    for n in SIZES:
        pos, vel, pref = rng.uniform(-3, 3, (n, 2)), rng.normal(0, 0.5, (n, 2)), rng.normal(0, 0.7, (n, 2))
        assert_same_step(pos, vel, pref, real=np.float64, reach_m=0.3)


points = st.tuples(st.integers(-12, 12), st.integers(-12, 12))


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    places=st.lists(points, min_size=1, max_size=80),
    spacing_m=st.sampled_from([0.125, 0.25, 0.3, 0.75, 1.5, 100.0]),
    capacity=st.integers(1, 12),
    range_m=st.sampled_from([0.5, 0.75, 1.5, 3.0]),
    reach_m=st.sampled_from([None, 0.0, 0.4]),
    hidden=st.integers(-1, 79),
)
def test_ties_are_ordered_by_index_by_grid_too(places, spacing_m, capacity, range_m, reach_m, hidden):
    pos = np.array(places, REAL) * REAL(spacing_m)
    zero = np.zeros_like(pos)
    hidden = min(hidden, len(pos) - 1)
    lists = assert_same_step(
        pos, zero, zero, range_m=range_m, max_neighbours=capacity, reach_m=reach_m, hidden=hidden
    ).neighbours
    for robot, found in enumerate(lists):
        assert found.tolist() == brute_force(robot, pos, range_m, capacity, hidden)


def assert_cells_hold_everybody_once(pos, done):
    """`starts` parts the candidates; each robot is one of them, in its own cell, in order of index there."""
    n, grid = len(pos), done.grid
    columns, bands = grid.shape
    starts = grid.starts[: columns * bands + 1]
    assert starts[0] == 0 and starts[-1] == n and (np.diff(starts) >= 0).all()
    assert columns >= 1 and bands >= 1 and columns * bands < len(grid.starts)
    slots = done.seen_slot[:n]
    assert sorted(slots) == list(range(n))
    np.testing.assert_array_equal(grid.place[slots], np.arange(n))
    np.testing.assert_array_equal(grid.cell[slots], np.repeat(np.arange(columns * bands), np.diff(starts)))
    np.testing.assert_array_equal(np.stack([done.seen_x[:n], done.seen_y[:n]], axis=1), done.body[slots, :2])
    same_cell = np.diff(grid.cell[slots]) == 0
    assert (np.diff(slots)[same_cell] > 0).all()


def assert_cells_are_where_robots_are(pos, done, edge_m):
    """Each robot's cell is the one that it stands in, of squares no smaller than asked for."""
    low_x, low_y, per_m = done.grid.frame
    columns, bands = done.grid.shape
    assert per_m <= 1 / edge_m
    np.testing.assert_array_equal([low_x, low_y], pos.min(axis=0))
    column, band = ((pos.astype(np.float64) - [low_x, low_y]) * per_m).astype(int).T
    np.testing.assert_array_equal(
        done.grid.cell, np.minimum(band, bands - 1) * columns + np.minimum(column, columns - 1)
    )


def assert_rows_are_close_and_as_long_as_may_be(pos, done, rows):
    """Each robot is in one lane of one row; rows keep to one band and a few cells, and none ends too early."""
    n, columns = len(pos), done.grid.shape[0]
    order = done.order[:rows]
    assert order[order != n].tolist() == done.seen_slot[:n].tolist()
    sizes = (order != n).sum(axis=1)
    assert (sizes > 0).all() and ((order != n) == (np.arange(LANES) < sizes[:, None])).all()
    first, last = done.grid.cell[order[:, 0]], done.grid.cell[order[np.arange(rows), sizes - 1]]
    assert (first // columns == last // columns).all() and (last - first <= ROW_SPAN_CELLS).all()
    can_go_on = (first[1:] // columns == first[:-1] // columns) & (first[1:] - first[:-1] <= ROW_SPAN_CELLS)
    assert (sizes[:-1][can_go_on] == LANES).all()


def assert_arranged(pos, edge_m):
    """All of the above; returns the number of cells and of rows."""
    pos = np.asarray(pos, REAL)
    done, rows = arranged(pos, edge_m)
    assert_cells_hold_everybody_once(pos, done)
    assert_cells_are_where_robots_are(pos, done, edge_m)
    assert_rows_are_close_and_as_long_as_may_be(pos, done, rows)
    return int(np.prod(done.grid.shape)), rows


@pytest.mark.parametrize("kind", PLACES)
def test_everybody_has_one_cell_and_one_lane(kind):
    for n in SIZES:
        for edge_m in (0.05, 0.75, 50.0):
            assert_arranged(PLACES[kind](n, np.random.default_rng(n)), edge_m)


coordinates = st.one_of(
    st.floats(-1e4, 1e4, width=32), st.floats(-1, 1, width=32), st.integers(-5, 5).map(float), st.just(1e30)
)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(
    pos=st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=60),
    edge_m=st.sampled_from([1e-3, 0.2, 0.75, 10.0]),
)
def test_wherever_robots_are_everybody_has_one_cell_and_one_lane(pos, edge_m):
    assert_arranged(pos, edge_m)


def test_cells_are_as_small_as_asked_for_where_robots_are_dense():
    pos = np.stack(np.divmod(np.arange(400), 20), axis=1) * 0.3
    cells, rows = assert_arranged(pos, 0.75)
    assert cells == (19 * 0.3 // 0.75 + 1) ** 2
    assert rows < 400 / LANES * 1.5


WORLDS = {
    "25r×8g": {"robots": 25, "groups": 8},
    "25r×8g, unknown learner": {"robots": 25, "groups": 8, "swarm_knows_learner": "no"},
    "17r×9g, uniform": {"robots": 17, "groups": 9, "flocking": "uniform"},
    "5r×3g, none, unknown learner": {"robots": 5, "groups": 3, "flocking": "none", "swarm_knows_learner": "no"},
}
NUM_WORLDS, STEPS = 3, 50


def searched(name, monkeypatch, grid):
    """A freshly reset batch that is searched by grid or not, in an arena so small that groups meet soon."""
    for module in (tile, step):
        monkeypatch.setattr(module, "GRID_FROM_ROBOTS", 1 if grid else 10**9)
    worlds = WorldBatch(WorldConfig(arena_radius_m=4.0, **WORLDS[name]), NUM_WORLDS)
    worlds.reset()
    return worlds


def record(worlds):
    """By name, everything that a run of 50 steps shows, `[STEPS, num_worlds, ...]`; the last world restarts once."""
    found = []
    for i in range(STEPS):
        if i == STEPS // 2:
            worlds.reset(np.arange(NUM_WORLDS) == NUM_WORLDS - 1)
        found.append(worlds.step(None if i % 3 else np.full(NUM_WORLDS, i % 8))._asdict() | worlds.get_state())
    return {key: np.stack([one[key] for one in found]) for key in found[0]}


@pytest.mark.parametrize("name", WORLDS)
def test_worlds_step_by_grid_as_they_would_without(name, monkeypatch):
    by_grid, without = searched(name, monkeypatch, True), searched(name, monkeypatch, False)
    first, second = record(by_grid), record(without)
    assert by_grid.tile.grid.shape.all() and not without.tile.grid.shape.any()
    for key in first:
        np.testing.assert_array_equal(first[key], second[key], err_msg=key)
    assert np.abs(first["pos_x"][-1] - first["pos_x"][0]).max() > 1  # they did move
