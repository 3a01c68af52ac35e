"""Accuracy of float32: bounds for most robots, because ORCA has no bound for all.

Where half-planes are almost parallel, a rounding error can rotate the velocity that violates them least by any angle.
RVO2's own float32 results have the same errors there. In jams the difference doubles every few steps, so trajectories
of two precisions diverge soon. `tests.benchmarks.exactness` prints the whole distribution.
"""

import numpy as np
import pytest

from sim_core.config import WorldConfig
from sim_core.pilot import Pilot
from sim_core.worlds import WorldBatch
from tests.sim_core.orca_scenes import KINDS, numbered_scene, world_scene
from tests.sim_core.precision import drifts, one_step_difference


@pytest.mark.parametrize("kind", KINDS)
def test_one_step_in_float32_equals_float64_up_to_rounding_for_most_robots(kind):
    errors = np.concatenate([one_step_difference(numbered_scene(kind, number)) for number in range(60)])
    assert len(errors) > 2000
    assert np.median(errors) < 3e-6 and np.quantile(errors, 0.9) < 1e-4


@pytest.mark.parametrize(("robots", "groups"), [(5, 3), (10, 2), (25, 8)])
def test_float32_drifts_from_float64_slowly(robots, groups):
    worlds, found = WorldBatch(WorldConfig(robots=robots, groups=groups), 4), []
    worlds.reset()
    for step in range(200):
        if step % 50 == 0:
            found += [drifts(*world_scene(worlds, world)) for world in range(4)]
        worlds.step(Pilot.FREE)
    after_1, after_10, _ = np.concatenate(found, axis=1)
    assert np.median(after_1) < 5e-7 and np.quantile(after_1, 0.99) < 1e-5
    assert np.median(after_10) < 5e-6 and np.quantile(after_10, 0.9) < 1e-3
