"""Accuracy of float32: the same kernels and scenes in float32 and in float64."""

import numpy as np

from tests.sim_core.kernels import orca_velocities
from tests.sim_core.parity import DEFAULTS

DRIFT_STEPS = (1, 10, 50)


def one_step_difference(scene):
    """Per robot, the distance of the float32 velocity from the float64 velocity, m/s."""
    new = [orca_velocities(*scene, real=real).astype(np.float64) for real in (np.float32, np.float64)]
    return np.linalg.norm(new[0] - new[1], axis=1)


def drifts(pos, vel, goal):
    """Distances of float32 positions from float64 positions after DRIFT_STEPS steps of ORCA towards the goals.

    Args:
      pos, vel, goal: `[n, 2]` float32, the start of both runs and each robot's goal.

    Returns:
      `[len(DRIFT_STEPS), n]` float64, metres.
    """
    paths = [path(pos, vel, goal, real) for real in (np.float32, np.float64)]
    return np.linalg.norm(paths[0] - paths[1], axis=-1)


def path(pos, vel, goal, real):
    """Positions `[len(DRIFT_STEPS), n, 2]` float64 of robots that head for their goals."""
    pos, vel, goal = (np.asarray(array, real) for array in (pos, vel, goal))
    time_step_s, found = real(DEFAULTS["time_step_s"]), []
    for step in range(1, max(DRIFT_STEPS) + 1):
        vel = orca_velocities(pos, vel, (goal - pos) * real(2), real=real)
        pos = pos + time_step_s * vel
        if step in DRIFT_STEPS:
            found.append(pos.astype(np.float64))
    return np.array(found)
