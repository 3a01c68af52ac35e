"""The example's shield in numpy beside the simulator's, on scenes of all kinds and in a control loop."""

import runpy
from pathlib import Path

import numpy as np
import pytest

import deploy
from deploy.commands.export import shield_numbers
from sim_core.config import WorldConfig
from tests.sim_core.half_planes import half_planes, least_violation, violation
from tests.sim_core.orca_scenes import GENERIC_KINDS, numbered_scene
from tests.sim_core.test_shield import CLEARANCE, config_of, shielded

EXAMPLE = runpy.run_path(str(Path(deploy.__file__).parent / "examples" / "shield.py"))


@pytest.mark.parametrize("knows", ["yes", "no"])
def test_it_drives_what_the_simulators_shield_lets_drive(knows):
    differ = tried = infeasible = 0
    for kind in GENERIC_KINDS:
        for number in range(5000, 5004):
            scene = numbered_scene(kind, number, 9)
            expected = shielded(scene, swarm_knows_learner=knows).astype(float)
            numbers = shield_numbers(config_of(9, arena_radius_m=30.0, swarm_knows_learner=knows))
            pos, vel, pref = (array.astype(float) for array in scene)
            for robot in range(9):
                others = np.arange(9) != robot
                found = EXAMPLE["shielded"](pref[robot], vel[robot], pos[others] - pos[robot], vel[others], numbers)
                tried += 1
                differ += np.abs(found - expected[robot]).max() > 2e-3
                if knows == "no" and len(lines := half_planes(scene.pos, scene.vel, robot, CLEARANCE)):
                    least = least_violation(lines, 1.0)
                    infeasible += least > 0
                    assert violation(lines, found) < max(least, 0.0) + 1e-6
    assert tried > 200 and differ == 0
    assert knows == "yes" or infeasible > 10


def test_alone_it_drives_what_was_asked_for():
    numbers = shield_numbers(WorldConfig())
    none = np.zeros((0, 2))
    np.testing.assert_array_equal(EXAMPLE["shielded"]([0.3, -0.4], np.zeros(2), none, none, numbers), [0.3, -0.4])
    np.testing.assert_allclose(EXAMPLE["shielded"]([3.0, -4.0], np.zeros(2), none, none, numbers), [0.6, -0.8])


def test_robots_that_are_not_sensed_forbid_nothing():
    numbers = shield_numbers(WorldConfig(method="in"))
    there, asked = np.array([[0.3, 0.0]]), np.array([1.0, 0.0])
    stopped = EXAMPLE["shielded"](asked, np.zeros(2), there, np.zeros((1, 2)), numbers)
    assert stopped[0] < 0.5
    for unseen in (there * np.nan, there * 10):
        np.testing.assert_array_equal(EXAMPLE["shielded"](asked, np.zeros(2), unseen, np.zeros((1, 2)), numbers), asked)
