"""Random turns of sampled transitions: each is a turn of the one that was sampled, and all turns occur alike."""

import numpy as np
import pytest
from scipy.stats import chisquare

from learner.config import RunConfig
from learner.update.augmentation import RandomTurns
from sim_core.config import WorldConfig

ROWS = 4_000


def config(method, **settings):
    return RunConfig(world=WorldConfig(method=method, **settings), random_turns=True)


def columns(config, rng):
    size = len(config.world.method_class.observation_names(config.world))
    return {
        "observation": np.tile(rng.normal(size=size).astype(np.float32), (ROWS, 1)),
        "action": np.full(ROWS, 3, np.int32),
        "reward": rng.normal(size=ROWS).astype(np.float32),
        "next_observation": np.tile(rng.normal(size=size).astype(np.float32), (ROWS, 1)),
    }


@pytest.mark.parametrize("method, turns", [("sensor", 8), ("in", 4), ("out", 4)])
def test_every_turn_occurs_alike_and_states_and_action_turn_together(method, turns):
    run = config(method)
    given = columns(run, np.random.default_rng(0))
    made = RandomTurns(run)({name: column.copy() for name, column in given.items()}, np.random.default_rng(1))
    counts = np.bincount(made["action"], minlength=8)
    assert np.count_nonzero(counts) == turns and chisquare(counts[counts > 0]).pvalue > 1e-3
    for name in ("observation", "next_observation"):
        rows = np.concatenate([made[name], made["action"][:, None]], axis=1)
        assert len(np.unique(rows, axis=0)) == turns == len(np.unique(made[name], axis=0))
    np.testing.assert_array_equal(made["reward"], given["reward"])


def test_columns_that_cannot_be_written_are_copied():
    """Ray's objects are read-only."""
    run = config("sensor")
    given = columns(run, np.random.default_rng(0))
    before = {name: column.copy() for name, column in given.items()}
    for column in given.values():
        column.flags.writeable = False
    made = RandomTurns(run)(given, np.random.default_rng(1))
    assert not np.array_equal(made["observation"], before["observation"])
    for name, column in before.items():
        np.testing.assert_array_equal(given[name], column)
