"""The unicycle: against plain trigonometry, within its limits, and as a robot without limits."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_core.checks import ConfigError
from sim_core.config import WorldConfig
from sim_core.outcomes import Outcome
from sim_core.worlds import Command, Pilot, WorldBatch
from tests.sim_core.batches import assert_go_on_alike, started

WORLD = WorldConfig(
    robots=5,
    groups=3,
    arena_radius_m=1.5,
    robot_radius_m=0.06,
    orca_radius_m=0.18,
    kinematics="unicycle",
    turn_rate_limit_deg_s=120.0,
    acceleration_limit_m_s2=3.0,
)
METHODS = ("sensor", "in", "out")


def make(num_worlds, method="sensor", seed=0, **fields):
    """A freshly reset batch."""
    return started(dataclasses.replace(WORLD, method=method, **fields), num_worlds, seed)


def driven(worlds):
    """The learning robots' velocities `[num_worlds, 2]`."""
    rows = np.arange(worlds.num_worlds), worlds.state.learner
    return np.stack([worlds.state.vel_x[rows], worlds.state.vel_y[rows]], axis=1).astype(float)


def goal_headings(worlds):
    rows = np.arange(worlds.num_worlds), worlds.state.learner
    away = worlds.goals()[rows[0], worlds.state.group[worlds.state.learner]] - worlds.positions()[rows]
    return np.arctan2(away[:, 1], away[:, 0]).astype(float)


class Oracle:
    """One unicycle by angles: it turns towards the asked velocity, then changes its speed towards its part ahead."""

    def __init__(self, heading, config):
        self.heading, self.speed = heading, 0.0
        self.turn = math.radians(config.turn_rate_limit_deg_s) * config.time_step_s
        self.change = config.acceleration_limit_m_s2 * config.time_step_s

    def drive(self, x, y):
        ahead = 0.0
        if x or y:
            error = math.remainder(math.atan2(y, x) - self.heading, 2 * math.pi)
            turned = max(-self.turn, min(self.turn, error))
            self.heading += turned
            ahead = max(0.0, math.hypot(x, y) * math.cos(error - turned))
        self.speed += max(-self.change, min(self.change, ahead - self.speed))
        return self.speed * math.cos(self.heading), self.speed * math.sin(self.heading)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("turn_deg_s, acceleration", [(120.0, 3.0), (30.0, 0.5), (2000.0, 100.0)])
def test_it_drives_as_the_oracle_does(method, turn_deg_s, acceleration):
    worlds = make(4, method, turn_rate_limit_deg_s=turn_deg_s, acceleration_limit_m_s2=acceleration)
    oracles = [Oracle(heading, worlds.config) for heading in goal_headings(worlds)]
    rng = np.random.default_rng(0)
    for step in range(60):
        if step % 6 == 0:
            asked = rng.uniform(-0.7, 0.7, (2, 4)).astype(np.float32) * (rng.random(4) > 0.2)
        worlds.step(Command(asked.astype(np.float32)))
        expected = [oracle.drive(*map(float, v)) for oracle, v in zip(oracles, asked.T, strict=True)]
        np.testing.assert_allclose(driven(worlds), expected, atol=2e-6)
        np.testing.assert_array_equal(worlds.asked, asked)


@pytest.mark.parametrize("driver", ["actions", Pilot.FREE, Pilot.SNAPPED])
def test_it_keeps_its_limits_whoever_drives(driver):
    worlds = make(8, "out", speed_error=0.2, heading_error_deg=20.0)
    turn = math.radians(120.0) * 0.05
    heading, speed = goal_headings(worlds), np.zeros(8)
    for step in range(60):
        worlds.step(np.arange(8) * (step // 3) % 8 if driver == "actions" else driver)
        velocity = driven(worlds)
        moved, now = np.arctan2(velocity[:, 1], velocity[:, 0]), np.linalg.norm(velocity, axis=1)
        fast = (now > 1e-3) & (speed > 1e-3)  # at rest it may turn unseen
        turned = np.abs(np.remainder(moved - heading + math.pi, 2 * math.pi) - math.pi)
        assert (turned[fast] <= turn + 1e-4).all()
        assert (np.abs(now - speed) <= 3.0 * 0.05 + 1e-5).all()
        heading, speed = moved, now
    assert now.max() > 0.5


@pytest.mark.parametrize("method", METHODS)
def test_without_limits_it_is_the_holonomic_robot(method):
    free = make(6, method, turn_rate_limit_deg_s=1e5, acceleration_limit_m_s2=1e5)
    plain = make(6, method, kinematics="holonomic")
    for step in range(20):
        action = np.arange(6) * (step // 2) % 8
        one, other = free.step(action), plain.step(action)
        np.testing.assert_array_equal(one.outcome, other.outcome)
        np.testing.assert_allclose(free.positions(), plain.positions(), atol=2e-4)


def test_a_robot_that_is_asked_to_rest_rolls_to_a_stop_and_keeps_its_heading():
    worlds = make(1, turn_rate_limit_deg_s=360.0, acceleration_limit_m_s2=2.0)
    heading = goal_headings(worlds)[0]
    ahead = np.array([[math.cos(heading)], [math.sin(heading)]], np.float32)
    speeds = []
    for step in range(20):
        worlds.step(Command(ahead if step < 10 else 0 * ahead))
        speeds.append(float(np.linalg.norm(driven(worlds))))
    np.testing.assert_allclose(speeds, [*np.arange(1, 11) / 10, *np.arange(9, -1, -1) / 10], atol=1e-5)
    worlds.step(Command(-0.5 * ahead))  # exactly behind: it turns on the spot, to the left
    assert np.linalg.norm(driven(worlds)) < 1e-6
    for _ in range(12):
        worlds.step(Command(-0.5 * ahead))
    np.testing.assert_allclose(driven(worlds)[0], -0.5 * ahead[:, 0], atol=1e-3)


@pytest.mark.parametrize("method", METHODS)
def test_off_its_settings_change_no_bit(method):
    plain = make(5, method, kinematics="holonomic")
    other = make(5, method, kinematics="holonomic", turn_rate_limit_deg_s=5.0, acceleration_limit_m_s2=0.1)
    assert set(plain.get_state()) == set(other.get_state()) and not [n for n in plain.get_state() if "unicycle" in n]
    for step in range(40):
        action = np.arange(5) * step % 8
        plain.step(action), other.step(action)
        for name, value in plain.get_state().items():
            np.testing.assert_array_equal(other.get_state()[name], value, err_msg=name)


@pytest.mark.parametrize("method", METHODS)
def test_a_saved_batch_goes_on_as_the_one_that_was_not_saved(method):
    fields = {"position_loss": 0.2, "command_delay_steps": 2, "horizon_steps": 40}
    worlds, restored = make(6, method, **fields), make(6, method, seed=50, **fields)
    for step in range(9):
        worlds.step(np.arange(6) * step % 8)
    restored.set_state(worlds.get_state())
    assert_go_on_alike(worlds, restored, 40)


@pytest.mark.parametrize("method", METHODS)
def test_every_learning_robot_of_a_world_is_one(method):
    """Each row against an oracle of its own, while others of its world end and FL-ORCA takes them over."""
    worlds = make(2, method, learners="2", swarm_knows_learner="yes")
    assert worlds.num_rows == 12
    rows = np.arange(12)
    goal = worlds.goals()[rows // 6, worlds.state.group[worlds.state.learner]]
    away = goal - worlds.positions()[rows // 6, worlds.state.learner]
    oracles = [Oracle(math.atan2(y, x), worlds.config) for x, y in away.astype(float)]
    rng, running, checked = np.random.default_rng(1), np.ones(12, bool), 0
    for _ in range(40):
        asked = rng.uniform(-0.7, 0.7, (2, 12)).astype(np.float32)
        worlds.step(Command(asked))
        velocity = np.stack([worlds.state.vel_x, worlds.state.vel_y], axis=-1)[rows // 6, worlds.state.learner]
        expected = np.array([oracle.drive(*map(float, v)) for oracle, v in zip(oracles, asked.T, strict=True)])
        np.testing.assert_allclose(velocity[running], expected[running], atol=2e-6)
        checked += running.sum()
        running &= worlds.outcome == Outcome.RUNNING
    assert checked > 100


@settings(max_examples=20, deadline=None, derandomize=True)
@given(
    method=st.sampled_from(METHODS),
    num_worlds=st.integers(2, 9),
    faults=st.sampled_from([{}, {"position_noise_m": 0.1, "command_delay_steps": 1}]),
    data=st.data(),
)
def test_a_world_depends_neither_on_its_batch_nor_on_masks_nor_on_order(method, num_worlds, faults, data):
    config = dataclasses.replace(WORLD, method=method, **faults)
    order = data.draw(st.permutations(range(num_worlds)))
    together, alone = WorldBatch(config, num_worlds), [WorldBatch(config, 1) for _ in range(num_worlds)]
    together.seed(order)
    together.reset()
    for seed, world in enumerate(alone):
        world.seed([seed])
        world.reset()
    for step in range(8):
        restarted = data.draw(st.integers(0, num_worlds - 1))
        seeds = np.array(order)
        together.reset(seeds == restarted)
        alone[restarted].reset()
        together.step(seeds * (step + 1) % 8)
        for seed, world in enumerate(alone):
            world.step(np.array([seed * (step + 1) % 8]))
            for name, value in world.get_state().items():
                np.testing.assert_array_equal(together.get_state()[name][order.index(seed)], value[0], err_msg=name)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"turn_rate_limit_deg_s": 0.0}, "turn_rate_limit_deg_s must be greater than 0"),
        ({"acceleration_limit_m_s2": -1.0}, "acceleration_limit_m_s2 must be greater than 0"),
        ({"shield": "orca"}, "which a unicycle does not; set kinematics = holonomic or shield = none"),
        ({"kinematics": "hover"}, "kinematics must be one of: holonomic, unicycle"),
    ],
)
def test_settings_that_cannot_be_are_refused(fields, words):
    with pytest.raises(ConfigError, match=words):
        dataclasses.replace(WORLD, **fields)
