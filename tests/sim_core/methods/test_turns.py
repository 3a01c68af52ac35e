"""An observation that is turned is the observation of the turned world, and so is the heading."""

import numpy as np
import pytest

from sim_core.config import WorldConfig
from sim_core.worlds import WorldBatch

WORLDS = 6
SETTINGS = {
    "sensor": {"method": "sensor"},
    "sensor, separate counts": {"method": "sensor", "sensor_counts": "separate", "sectors": 12, "history": 3},
    "in": {"method": "in"},
    "in, any angle": {"method": "in", "ellipse_covariance": "full", "sectors": 7, "group_rows": 6, "history": 2},
    "out": {"method": "out", "ellipse_covariance": "full", "stop_action": True},
    "out, half turns": {"method": "out", "sectors": 6},
}


def turned(batch, angle):
    """Observations of the batch's worlds after all of their positions and goals have been turned about the origin."""
    saved = {name: array.copy() for name, array in batch.get_state().items()}
    changed = {name: array.copy() for name, array in saved.items()}
    cos, sin = np.cos(angle), np.sin(angle)
    for kind in ("pos", "goal"):
        x, y = saved[f"{kind}_x"], saved[f"{kind}_y"]
        changed[f"{kind}_x"][:], changed[f"{kind}_y"][:] = cos * x - sin * y, sin * x + cos * y
    observation = batch.set_state(changed).copy()
    batch.set_state(saved)
    return observation


@pytest.mark.parametrize("name", SETTINGS)
def test_a_turned_observation_is_that_of_the_turned_world(name):
    config = WorldConfig(robots=5, groups=4, apf_range_m=1.2, **SETTINGS[name] | {"history": 1})
    batch = WorldBatch(config, WORLDS)
    batch.seed(list(range(WORLDS)))
    batch.reset()
    rng = np.random.default_rng(0)
    for _ in range(30):
        batch.step(rng.integers(config.num_actions, size=WORLDS))
    method, turns = batch.method, batch.method.turns(config)
    assert turns > 1 and config.sectors % turns == 0
    for part in range(turns):
        observation = batch.observation().copy()
        method.turn(observation, np.full(WORLDS, part))
        wanted = turned(batch, 2 * np.pi * part / turns)
        if config.method == "sensor":  # rounding may put a robot on the other side of an edge
            assert np.abs(observation.astype(int) - wanted).sum() <= 2
        else:
            np.testing.assert_allclose(observation, wanted, atol=2e-5)


@pytest.mark.parametrize("levels", [1, 3])
@pytest.mark.parametrize("name", SETTINGS)
def test_a_heading_turns_by_the_same_angle_and_keeps_its_speed_and_a_stop_stays(name, levels):
    config = WorldConfig(robots=5, groups=4, **SETTINGS[name] | {"speed_levels": levels, "stop_action": True})
    method = WorldBatch(config, 1).method
    turns = method.turns(config)
    for part in range(turns):
        action = np.arange(config.num_actions, dtype=np.int32)
        method.turn_actions(action, np.full(len(action), part))
        angle = 2 * np.pi * part / turns
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        np.testing.assert_allclose(method.headings[action], method.headings @ turn.T, atol=1e-6)
        assert action[-1] == config.num_actions - 1


@pytest.mark.parametrize("name", SETTINGS)
def test_every_observation_of_a_history_turns_alike(name):
    settings = SETTINGS[name]
    one = WorldConfig(robots=5, groups=4, **settings | {"history": 1})
    several = WorldConfig(robots=5, groups=4, **settings | {"history": 3})
    first, second = WorldBatch(one, WORLDS), WorldBatch(several, WORLDS)
    for batch in (first, second):
        batch.seed(list(range(WORLDS)))
        batch.reset()
    observation, stacked = first.observation().copy(), second.observation().copy()  # three times the first one
    parts = np.arange(WORLDS) % first.method.turns(one)
    first.method.turn(observation, parts)
    second.method.turn(stacked, parts)
    width = first.method.row_size or observation.shape[1]
    repeated = np.repeat(observation.reshape(WORLDS, -1, 1, width), 3, axis=2)
    rows = stacked.reshape(WORLDS, -1, 3, width)
    np.testing.assert_allclose(rows, np.where(rows == 0, 0, repeated), atol=1e-6)


def test_sectors_that_face_the_goal_have_no_turns():
    config = WorldConfig(sector_frame="goal")
    assert config.method_class.turns(config) == 1
