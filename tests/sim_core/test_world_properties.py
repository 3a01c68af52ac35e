"""Worlds of a batch are independent, and the swarm is independent of a learning robot that it does not know."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_core.config import WorldConfig
from sim_core.pilot import Pilot
from sim_core.worlds import WorldBatch

STEPS, MAX_WORLDS = 50, 17
SETUPS = {  # robots, groups, arena radius (m; small, so that groups meet soon), whether the swarm knows the learner
    "5r×1g": (5, 1, 1.5, True),
    "5r×3g": (5, 3, 1.2, False),
    "10r×2g": (10, 2, 1.5, True),
    "25r×2g": (25, 2, 1.8, False),
}


def batch(name, seeds):
    """A freshly reset batch with one world per seed."""
    robots, groups, arena_radius_m, knows = SETUPS[name]
    known = "yes" if knows else "no"
    config = WorldConfig(robots=robots, groups=groups, arena_radius_m=arena_radius_m, swarm_knows_learner=known)
    worlds = WorldBatch(config, len(seeds))
    worlds.seed(seeds)
    worlds.reset()
    return worlds


def plan(seeds):
    """Yields per step (actions or a pilot, worlds to restart before it); a world's entries depend on its seed alone."""
    actions = np.stack([np.random.default_rng(seed).integers(0, 8, STEPS) for seed in seeds], axis=1)
    for step in range(STEPS):
        restarts = np.array([(3 * step + 5 * seed) % 23 == 0 for seed in seeds])
        yield (actions[step] if step % 3 else Pilot.FREE), restarts


def records(worlds, seeds):
    """All results and states of the plan's steps by name, `[STEPS, num_worlds, ...]`."""
    found = []
    for action, restarts in plan(seeds):
        if restarts.any():
            worlds.reset(restarts)
        found.append(worlds.step(action)._asdict() | worlds.get_state())
    return {name: np.stack([one[name] for one in found]) for name in found[0]}


@pytest.mark.parametrize("name", SETUPS)
def test_batches_of_every_size_equal_their_worlds_one_by_one(name):
    seeds = list(range(MAX_WORLDS))
    alone = [records(batch(name, [seed]), [seed]) for seed in seeds]
    assert len({one["pos_x"].tobytes() for one in alone}) == MAX_WORLDS
    assert any((np.diff(one["steps"][:, 0]) < 1).any() for one in alone)  # some worlds did restart
    for num_worlds in range(1, MAX_WORLDS + 1):
        some = seeds[-num_worlds:]
        together = records(batch(name, some), some)
        for i, seed in enumerate(some):
            for key, values in together.items():
                np.testing.assert_array_equal(values[:, i], alone[seed][key][:, 0], err_msg=f"{key}, {num_worlds}")


@pytest.mark.parametrize("name", SETUPS)
def test_robots_of_these_worlds_meet(name):
    """If they did not, the tests above would show little."""
    worlds = batch(name, list(range(4)))
    nearest_m = np.inf
    for _ in range(STEPS):
        worlds.step(Pilot.FREE)
        pos = worlds.positions()
        distance_m = np.linalg.norm(pos[:, :, None] - pos[:, None], axis=-1)
        nearest_m = min(nearest_m, distance_m[distance_m > 0].min())
    assert nearest_m < 0.4


def random_position(pos, learner, rng):
    """A position for the learning robot of one world: at, beside or far away from another robot."""
    if rng.random() < 0.3:
        return rng.uniform(-1e6, 1e6, 2)
    others = np.delete(pos, learner, axis=0)
    return rng.choice(others) + rng.choice([0.0, 1e-6, 0.1, 1.0]) * rng.normal(0, 1, 2)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(robots=st.integers(2, 12), groups=st.integers(1, 4), num_worlds=st.integers(1, 9), seed=st.integers(0, 10**6))
def test_an_unknown_learning_robot_at_any_position_changes_no_other_robot(robots, groups, num_worlds, seed):
    config = WorldConfig(robots=robots, groups=groups, arena_radius_m=2.0, swarm_knows_learner="no")
    plain, displaced = WorldBatch(config, num_worlds), WorldBatch(config, num_worlds)
    for worlds in (plain, displaced):
        worlds.seed(list(range(seed, seed + num_worlds)))
        worlds.reset()
    rng, rows, learner = np.random.default_rng(seed), np.arange(num_worlds), plain.get_state()["learner"]
    others = np.arange(config.num_robots) != learner[:, None]
    for _ in range(30):
        state, pos = displaced.get_state(), displaced.positions()
        positions = [random_position(pos[w], learner[w], rng) for w in rows]
        state["pos_x"][rows, learner], state["pos_y"][rows, learner] = np.transpose(positions)
        state["vel_x"][rows, learner], state["vel_y"][rows, learner] = rng.normal(0, 10, (2, num_worlds))
        displaced.set_state(state)
        plain.step(Pilot.FREE), displaced.step(Pilot.FREE)
        expected, found = plain.get_state(), displaced.get_state()
        np.testing.assert_array_equal(found["rng"], expected["rng"])
        for name in ("pos_x", "pos_y", "vel_x", "vel_y", "machine"):
            np.testing.assert_array_equal(found[name][others], expected[name][others], err_msg=name)
