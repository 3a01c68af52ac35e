"""The shield: against RVO2 (pyrvo) and against all candidate points, and what it does to episodes."""

import dataclasses

import numpy as np
import pytest

from actors.evaluation.evaluator import evaluate
from actors.policy.baselines import Baseline
from actors.rollout.env_spec import EnvSpec
from sim_core import ENV_ID
from sim_core.config import WorldConfig
from sim_core.outcomes import Outcome
from sim_core.pilot import Pilot
from sim_core.shield import SPEED_MARGIN, Shield
from sim_core.state import empty_state
from sim_core.worlds import WorldBatch
from tests.sim_core.half_planes import Clearance, closest_permitted, half_planes, least_violation, violation
from tests.sim_core.orca_scenes import GENERIC_KINDS, KINDS, numbered_scene
from tests.sim_core.parity import BOUND_M_S, compare, total

RADIUS_M, HORIZON_S, RANGE_M = 0.12, 0.5, 1.5
CLEARANCE = Clearance(RADIUS_M, HORIZON_S, RANGE_M)


def config_of(num_robots, **fields):
    """A world whose shield keeps RADIUS_M free for HORIZON_S."""
    return WorldConfig(
        robots=num_robots, groups=1, shield="orca", shield_margin_m=RADIUS_M - 0.1, start_spacing_m=0.4, **fields
    )


def shielded(scene, **fields):
    """The velocities `[n, 2]` that the shield lets each robot of a scene drive, one after the other as the learner."""
    n = len(scene.pos)
    config = config_of(n, arena_radius_m=30.0, **fields)
    state = empty_state(config, n, np.float32)
    state.pos_x[:], state.pos_y[:] = scene.pos.T[:, None]
    state.vel_x[:], state.vel_y[:] = scene.vel.T[:, None]
    state.learner[:] = np.arange(n)
    command = scene.pref.T.copy()
    Shield(config).project(state, np.ones(n, np.bool_), *command)
    return command.T


@pytest.mark.parametrize("kind", KINDS)
def test_with_half_of_the_avoidance_it_gives_rvo2s_velocity(kind):
    found = []
    for number in range(3000, 3012):
        scene = numbered_scene(kind, number, 30)
        settings = {"radius_m": RADIUS_M, "horizon_s": HORIZON_S, "range_m": RANGE_M, "max_neighbours": 30}
        own = shielded(scene, swarm_knows_learner="yes")
        found.append(compare(scene, own, max_speed_m_s=SPEED_MARGIN, **settings))
    found = total(found)
    assert found.robots == 360 and found.unexplained == 0 and found.worst_m_s <= BOUND_M_S
    assert found.infeasible > 0 or kind not in GENERIC_KINDS


def test_with_all_of_the_avoidance_it_gives_the_nearest_permitted_or_the_least_bad_velocity():
    feasible = infeasible = changed = 0
    for kind in GENERIC_KINDS:
        for number in range(4000, 4008):
            scene = numbered_scene(kind, number, 9)
            own = shielded(scene, swarm_knows_learner="no").astype(float)
            for robot in range(9):
                lines = half_planes(scene.pos, scene.vel, robot, CLEARANCE)
                if not len(lines):
                    continue
                best = closest_permitted(lines, SPEED_MARGIN, scene.pref[robot].astype(float))
                if best is None:
                    infeasible += 1
                    least = max(least_violation(lines, SPEED_MARGIN), 0.0)
                    assert violation(lines, own[robot]) < least + 2e-3 * (1 + least)
                else:
                    feasible += 1
                    changed += np.abs(best - scene.pref[robot]).max() > 1e-3
                    near = np.linalg.norm(own[robot] - best) < 2e-3
                    assert near or violation(lines, own[robot]) < 2e-3  # a corner that float32 sees elsewhere
    assert feasible > 100 and infeasible > 20 and changed > 50


def test_a_permitted_velocity_stays_bit_for_bit_and_a_masked_world_too():
    config = config_of(4, arena_radius_m=6.0)
    state = empty_state(config, 11, np.float32)
    state.pos_x[:], state.pos_y[:] = [0.0, 1.0, -1.0, 0.0], [0.0, 1.0, 1.0, 1.4]
    state.pos_x[5], state.pos_y[5] = [0.0, 0.25, -3.0, 3.0], [0.0, 0.0, 0.0, 0.0]
    state.pos_x[6] = state.pos_x[5]
    x, y = np.full(11, 0.6, np.float32), np.full(11, -0.80000001, np.float32)
    x[5:7], y[5:7] = 1.0, 0.0
    mask = np.arange(11) != 6
    before = x.copy(), y.copy()
    Shield(config).project(state, mask, x, y)
    apart = np.arange(11) != 5
    np.testing.assert_array_equal(x[apart], before[0][apart])
    np.testing.assert_array_equal(y[apart], before[1][apart])
    assert x[5] < 0.2


def test_robots_that_are_not_sensed_induce_nothing():
    config = config_of(2, arena_radius_m=6.0)
    state = empty_state(config, 2, np.float32)
    state.pos_x[:] = [0.0, 0.25]
    state.pos_x[1, 1] = np.nan
    command = np.array([[1.0, 1.0], [0.0, 0.0]], np.float32)
    Shield(config).project(state, np.ones(2, np.bool_), *command)
    assert command[0, 0] < 0.5 and command[0, 1] == 1.0


WORLD = {"robot_radius_m": 0.06, "orca_radius_m": 0.18, "max_neighbours": 16, "ellipse_counts_learner": True}


@pytest.mark.parametrize("method", ["in", "out"])
def test_it_keeps_the_rule_that_collides_from_colliding(method):
    config = WorldConfig(method=method, robots=5, groups=4, arena_radius_m=3.0, apf_gain_m4_s=0.0, **WORLD)
    seeds = list(range(3_000_000_000, 3_000_000_040))
    plain, safe = (
        evaluate(EnvSpec(ENV_ID, dataclasses.replace(config, shield=shield)), Baseline.GREEDY, seeds).outcome
        for shield in ("none", "orca")
    )
    assert (plain == Outcome.COLLISION).mean() > 0.8
    assert (safe == Outcome.COLLISION).mean() < 0.1 and (safe == Outcome.GOAL).mean() > 0.8


def test_the_velocity_asked_for_is_kept_beside_the_one_driven():
    worlds = WorldBatch(WorldConfig(method="in", robots=5, groups=2, arena_radius_m=2.0, shield="orca", **WORLD), 20)
    worlds.reset()
    rows, learner, differ = np.arange(20), worlds.state.learner, 0
    for _ in range(30):
        worlds.step(np.full(20, 3))
        np.testing.assert_allclose(worlds.asked, worlds.method.headings[3][:, None].repeat(20, axis=1))
        driven = np.stack([worlds.state.vel_x[rows, learner], worlds.state.vel_y[rows, learner]])
        differ += (driven != worlds.asked).any(axis=0).sum()
    assert 0 < differ < 600


def test_fl_orca_is_shielded_too():
    config = WorldConfig(method="out", robots=5, groups=4, arena_radius_m=1.5, shield="orca", **WORLD)
    worlds = WorldBatch(config, 10)
    worlds.reset()
    for _ in range(20):
        worlds.step(Pilot.FREE)
    assert np.abs(worlds.asked).max() <= 1.001 and np.isfinite(worlds.positions()).all()
