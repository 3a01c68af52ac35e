"""One step of ORCA against its reference implementation RVO2 (pyrvo), and properties of its velocities."""

import numpy as np
import pytest

from sim_core.config import WorldConfig
from sim_core.pilot import Pilot
from sim_core.worlds import WorldBatch
from tests.sim_core.kernels import orca_velocities
from tests.sim_core.orca_scenes import (
    GENERIC_KINDS,
    KINDS,
    Scene,
    coincides,
    goal_scene,
    heading_scene,
    numbered_scene,
    tie_margin_sq,
    world_scene,
)
from tests.sim_core.parity import (
    BOUND_M_S,
    SETTINGS,
    compare,
    rvo2_half_planes,
    rvo2_step,
    rvo2_velocities,
    total,
    worst_violation,
)

MAX_SPEED_M_S, HORIZON_S = 1.0, 2.0
SCENES_PER_KIND = 60


def scene_of(pos, vel, pref):
    """A scene from lists."""
    return Scene(*(np.array(array, np.float32) for array in (pos, vel, pref)))


@pytest.mark.parametrize("kind", KINDS)
def test_one_step_matches_rvo2(kind):
    found = total(compare(numbered_scene(kind, number)) for number in range(SCENES_PER_KIND))
    assert found.unexplained == 0 and found.worst_m_s <= BOUND_M_S
    assert found.robots > 2000
    assert found.too_fast < 0.15 * found.robots
    assert (found.ties > 0) == (kind not in GENERIC_KINDS) and found.ties < 0.15 * found.robots
    assert (found.coincident > 0) == (kind == "coincident")
    assert found.infeasible > 0.1 * found.robots  # the third program is tested too


@pytest.mark.parametrize("kind", GENERIC_KINDS)
def test_float32_equals_rvo2_bit_for_bit(kind):
    found = total(compare(numbered_scene(kind, number)) for number in range(1000, 1000 + SCENES_PER_KIND))
    assert found.robots > 1000 and found.equal + found.too_fast >= found.robots


@pytest.mark.parametrize("name", [name for name, changes in SETTINGS.items() if changes])
def test_one_step_with_other_settings_matches_rvo2(name):
    found = total(
        compare(numbered_scene(kind, number), **SETTINGS[name]) for kind in KINDS for number in range(2000, 2012)
    )
    assert found.unexplained == 0 and found.worst_m_s <= BOUND_M_S
    assert found.robots > 2000 and found.ties + found.coincident > 0


def test_renumbering_changes_rvo2s_result_only_where_robots_tie():
    rng, changed = np.random.default_rng(0), 0
    for number in range(60):
        scene = numbered_scene("lattice", number)
        order = rng.permutation(len(scene.pos))
        first, second = (rvo2_velocities(rvo2_step(s)) for s in (scene, Scene(*(array[order] for array in scene))))
        differs = np.abs(first[order] - second).max(axis=1) > BOUND_M_S
        changed += differs.sum()
        assert np.all(tie_margin_sq(scene.pos)[order][differs] == 0)
    assert changed > 10


@pytest.mark.parametrize("position", [(0.0, 0.0), (3.7, -5.1)])
def test_rvo2_ignores_a_neighbour_of_equal_position_and_velocity(position):
    scene = scene_of([position, position], [[0.4, -0.3]] * 2, [[1, 0], [0, 0.5]])
    sim = rvo2_step(scene)
    assert np.isnan(rvo2_half_planes(sim, 0)).all() and np.isnan(rvo2_half_planes(sim, 1)).all()
    np.testing.assert_array_equal(rvo2_velocities(sim), scene.pref)


def test_robots_of_equal_position_and_different_velocities_match_rvo2():
    scene = scene_of([[1, 2]] * 2, [[0.4, -0.3], [0.4, 0.1]], [[1, 0], [0, 0.5]])
    found = compare(scene)
    assert found.equal == found.robots == 2 and found.infeasible == 2


EPISODES = [(25, 8, 6.0), (5, 8, 3.0), (10, 2, 2.5), (25, 2, 3.0), (20, 4, 4.0), (15, 1, 2.0)]


@pytest.mark.parametrize(("robots", "groups", "arena_radius_m"), EPISODES)
def test_every_tenth_step_of_an_episode_matches_rvo2(robots, groups, arena_radius_m):
    worlds = WorldBatch(WorldConfig(robots=robots, groups=groups, arena_radius_m=arena_radius_m), 1)
    worlds.seed([robots])
    worlds.reset()
    rng, found = np.random.default_rng(robots), []
    for step in range(400):
        worlds.step(Pilot.FREE)
        if step % 10 == 0:
            found.append(compare(heading_scene(worlds, 0, rng)))
    found = total(found)
    assert found.robots == 40 * worlds.config.num_robots and found.infeasible > 0
    assert found.unexplained == found.ties == found.coincident == 0 and found.worst_m_s <= BOUND_M_S


@pytest.mark.parametrize(("robots", "groups", "arena_radius_m"), EPISODES)
def test_worlds_without_flocking_move_as_rvo2_does(robots, groups, arena_radius_m):
    config = WorldConfig(robots=robots, groups=groups, arena_radius_m=arena_radius_m, flocking="none")
    worlds, found = WorldBatch(config, 3), []
    worlds.reset()
    for step in range(300):
        before = [goal_scene(worlds, world) for world in range(3)] if step % 10 == 0 else []
        worlds.step(Pilot.FREE)
        found += [compare(scene, world_scene(worlds, world).vel) for world, scene in enumerate(before)]
    found = total(found)
    assert found.robots == 90 * config.num_robots and found.infeasible > 0
    assert found.unexplained == found.ties == found.coincident == 0
    assert found.equal + found.too_fast >= found.robots


def test_a_robot_with_few_neighbours_matches_rvo2_beside_robots_with_many():
    # From an episode: both half-planes have the same direction, and the third program ends inside both of them by a
    # rounding error. The zeros of an absent half-plane would then count as violated.
    few = scene_of(
        [[-2.7706194, 1.6009108], [-3.167522, 1.441784], [-2.4498496, 1.8972486]],
        [[-0.9966004, -0.08238675], [-0.92208725, -0.16356142], [-0.94915766, -0.21959141]],
        [[-1.1718456, -0.2763374], [-0.995455, -0.12915634], [-0.87023354, -0.4629047]],
    )
    crowd = numbered_scene("overlapping", 0, 12)
    crowd = crowd._replace(pos=crowd.pos + np.float32(100))
    mixed = Scene(*(np.concatenate([a[:1], b, a[1:]]) for a, b in zip(few, crowd, strict=True)))
    np.testing.assert_array_equal(orca_velocities(*mixed)[0], rvo2_velocities(rvo2_step(few))[0])
    assert compare(mixed).unexplained == 0


@pytest.mark.parametrize("kind", GENERIC_KINDS)
def test_velocities_obey_the_half_planes_and_the_speed_limit(kind):
    feasible = 0
    for number in range(3000, 3040):
        scene = numbered_scene(kind, number, n=30)
        new, sim = orca_velocities(*scene), rvo2_step(scene)
        assert np.all(np.linalg.norm(new.astype(np.float64), axis=1) <= MAX_SPEED_M_S + 1e-5)
        for robot, velocity in enumerate(new):
            lines = rvo2_half_planes(sim, robot)
            if exists_permitted_velocity(lines):
                feasible += 1
                assert worst_violation(lines, velocity) <= 1e-5
    assert feasible > (5 if kind == "overlapping" else 40)


def exists_permitted_velocity(lines):
    """Whether any point of a fine grid over the speed disc lies inside all half-planes by a margin."""
    axis = np.linspace(-MAX_SPEED_M_S, MAX_SPEED_M_S, 41)
    x, y = (grid.ravel()[:, None] for grid in np.meshgrid(axis, axis))
    violation = lines[:, 2] * (lines[:, 1] - y) - lines[:, 3] * (lines[:, 0] - x)
    return bool(((violation < -1e-3).all(axis=1) & (x[:, 0] ** 2 + y[:, 0] ** 2 < MAX_SPEED_M_S**2)).any())


def test_a_robot_alone_takes_its_preferred_velocity_up_to_the_speed_limit():
    new = orca_velocities([[0, 0]], [[0, 0]], [[0.3, -0.4]])
    np.testing.assert_array_equal(new, np.array([[0.3, -0.4]], np.float32))
    np.testing.assert_allclose(orca_velocities([[0, 0]], [[0, 0]], [[3.0, -4.0]]), [[0.6, -0.8]], atol=1e-6)


@pytest.mark.parametrize("distance_m", [0.5, 1.0, 1.4])
def test_two_robots_that_meet_head_on_share_the_avoidance(distance_m):
    # Closed form: the relative speed of 2 may fall to (distance - combined radius) / horizon; each takes half of it.
    scene = scene_of([[0, 0], [distance_m, 0]], [[1, 0], [-1, 0]], [[1, 0], [-1, 0]])
    new = orca_velocities(*scene)
    np.testing.assert_allclose(new[1], -new[0], atol=1e-5)
    assert worst_violation(rvo2_half_planes(rvo2_step(scene), 0), [1, 0]) > 0
    assert np.linalg.norm(new[0] - scene.vel[0]) < np.linalg.norm([1 - (distance_m - 0.4) / HORIZON_S / 2, 0]) + 1e-5


@pytest.mark.parametrize("velocity", [(0.0, 0.0), (0.4, -0.3)])
@pytest.mark.parametrize("position", [(0.0, 0.0), (3.7, -5.1)])
def test_coincident_robots_separate_in_opposite_directions_at_full_speed(position, velocity):
    new = orca_velocities([position, position], [velocity, velocity], [velocity, velocity])
    np.testing.assert_allclose(np.linalg.norm(new, axis=1), MAX_SPEED_M_S, atol=1e-5)
    np.testing.assert_allclose(new[0], -new[1], atol=1e-6)
    assert (new[0] - new[1])[0] > 0.5


@pytest.mark.parametrize("count", [3, 11])
def test_velocities_of_many_coincident_robots_are_finite(count):
    new = orca_velocities(np.zeros((count, 2)), np.zeros((count, 2)), np.ones((count, 2)))
    assert np.isfinite(new).all()
    assert np.all(np.linalg.norm(new, axis=1) <= MAX_SPEED_M_S + 1e-5)


@pytest.mark.parametrize("offset_m", [1e-3, 1e-6, 1e-12, 1e-19, 1e-22, 1e-30, 1e-38, 1e-44])
def test_nearly_coincident_robots_separate_at_full_speed(offset_m):
    # The squares of such offsets underflow. The direction must keep its unit length.
    new = orca_velocities([[0, 0], [offset_m, -0.7 * offset_m]], np.zeros((2, 2)), np.zeros((2, 2)))
    np.testing.assert_allclose(np.linalg.norm(new, axis=1), MAX_SPEED_M_S, atol=1e-5)
    np.testing.assert_allclose(new[0], -new[1], atol=1e-6)


def test_robots_that_coincide_by_chance_separate():
    separated = 0
    for number in range(20):
        scene = numbered_scene("coincident", number, n=12)
        pos = scene.pos + 0.05 * orca_velocities(*scene)
        separated += coincides(scene.pos).sum() - coincides(pos).sum()
    assert separated > 100
