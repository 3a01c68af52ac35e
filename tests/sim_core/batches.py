"""Batches of worlds as several tests begin and compare them."""

import numpy as np

from sim_core.config import WorldConfig
from sim_core.outcomes import Outcome
from sim_core.worlds import WorldBatch


def started(config: WorldConfig, num_worlds: int, seed: int = 0) -> WorldBatch:
    """A freshly reset batch; world i has the seed `seed` + i."""
    worlds = WorldBatch(config, num_worlds)
    worlds.seed(list(range(seed, seed + num_worlds)))
    worlds.reset()
    return worlds


def assert_go_on_alike(worlds: WorldBatch, restored: WorldBatch, steps: int) -> None:
    """Two batches in the same state give the same in every one of the next steps, and begin the same episodes."""
    for step in range(steps):
        action = np.arange(worlds.num_worlds) * step % 8
        one, other = worlds.step(action), restored.step(action)
        for name, value in one._asdict().items():
            np.testing.assert_array_equal(getattr(other, name), value, err_msg=name)
        ended = one.outcome != Outcome.RUNNING
        if ended.any():
            np.testing.assert_array_equal(worlds.reset(ended), restored.reset(ended))
