"""Rollout workers of worlds in which several robots learn: a robot is an environment and waits for its world's end."""

import json

import numpy as np
import pytest

from actors.policy.policy import Policy
from actors.rollout.env_spec import EnvSpec
from actors.rollout.vector_env import env_shape, make_vector_env
from actors.rollout.worker import RolloutSettings, RolloutWorker
from actors.service.messages import transition_dtype
from sim_core import ENV_ID
from sim_core.config import WorldConfig
from sim_core.envs import SwarmVectorEnv
from tests.packed import unpack

SMALL = {"robots": 4, "groups": 2, "arena_radius_m": 2.0, "horizon_steps": 40, "outside_limit_steps": 5}
STEPS, GAMMA = 70, 0.9
METHODS = ("sensor", "in", "out")


@pytest.fixture
def make_worker(make_weights):
    """Function: a worker of two worlds of eight learning robots, with random weights."""

    def make(method="sensor", n_step=1, num_envs=16, **settings):
        spec = EnvSpec(ENV_ID, WorldConfig(**(SMALL | {"learners": 1.0, "method": method} | settings)))
        worker = RolloutWorker(RolloutSettings(spec, num_envs, STEPS, n_step, GAMMA, 5), 0, 0)
        worker.set_weights(make_weights(spec, version=1, time_s=0.0))
        return spec, worker

    return make


def worlds_of(worker):
    """What the worker's environment saves."""
    arrays = worker.get_state()["arrays"]
    return {name.removeprefix("world_"): array for name, array in arrays.items() if name.startswith("world_")}


def played(spec, worlds, policy, steps):
    """What each robot decides, gains and sees, step by step, in plain Python: `[step][row]`, None while it waits."""
    env = SwarmVectorEnv(16, **spec.settings)
    observation, told = env.set_state(worlds), []
    for _ in range(steps):
        action = policy.greedy(observation)
        after, reward, terminated, truncated, infos = env.step(action)
        done = terminated | truncated
        reached = np.where(done[:, None], infos["final_obs"], after) if done.any() else after
        told.append(
            [
                (observation[row], action[row], reward[row], reached[row], terminated[row], done[row])
                if infos["decided"][row]
                else None
                for row in range(16)
            ]
        )
        observation = after
    return told


def n_step_transitions(told, n_step):
    """The transitions of every robot's own chain of steps, by step and row; those that need later steps are not."""
    found = []
    for step in range(len(told)):
        for row in range(16):
            if told[step][row] is None:
                continue
            value, last = 0.0, step
            for ahead in range(n_step):
                last = step + ahead
                if last == len(told):
                    break
                value += GAMMA**ahead * told[last][row][2]
                if told[last][row][5]:
                    break
            if last < len(told):
                observation, action = told[step][row][:2]
                discount = 0.0 if told[last][row][4] else GAMMA ** (last + 1 - step)
                found.append((observation, action, value, discount, told[last][row][3]))
    return found


@pytest.mark.parametrize("n_step", [1, 3])
@pytest.mark.parametrize("method", METHODS)
def test_each_robot_has_a_chain_of_transitions_of_its_own(make_worker, method, n_step):
    spec, worker = make_worker(method, n_step)
    worlds = worlds_of(worker)
    policy = Policy(worker._policy.weights)
    block = worker.collect(0.0)
    told = played(spec, worlds, policy, STEPS)
    expected = n_step_transitions(told, n_step)
    rows = unpack(block.packed, transition_dtype(env_shape(spec).observation_space))
    assert len(rows) == len(expected) == block.header.made
    for i, name in enumerate(("observation", "action", "reward", "discount", "next_observation")):
        np.testing.assert_allclose(rows[name], np.array([each[i] for each in expected]), rtol=1e-6, err_msg=name)
    decided = sum(step is not None for steps in told for step in steps)
    assert block.header.env_steps == decided < STEPS * 16  # some waited
    ends = [step for steps in told for step in steps if step is not None and step[5]]
    assert len(block.episodes.outcome) == len(ends) > 16


@pytest.mark.parametrize("settings", [{}, {"ended_learners": "leave"}, {"history": 2, "position_loss": 0.2}])
def test_a_restored_worker_goes_on_bit_for_bit(make_worker, settings):
    _, first = make_worker(n_step=3, **settings)
    _, second = make_worker(n_step=3, **settings)
    first.collect(0.4)
    state = first.get_state()
    second.set_state(state["arrays"], json.loads(json.dumps(state["meta"])))
    one, same = first.collect(0.4), second.collect(0.4)
    for a, b in zip((*one.packed, *one.episodes), (*same.packed, *same.episodes), strict=True):
        np.testing.assert_array_equal(a, b)
    assert one.header.env_steps == same.header.env_steps


@pytest.mark.parametrize(
    ("learners", "num_envs", "rows"), [("one", 64, 64), (1.0, 64, 64), (1.0, 20, 16), (1.0, 3, 8), (3, 64, 60)]
)
def test_as_many_whole_worlds_as_fit_into_the_environments(learners, num_envs, rows):
    spec = EnvSpec(ENV_ID, WorldConfig(**SMALL, learners=learners))
    env = make_vector_env(spec, num_envs)
    assert env.num_envs == rows == sum(spec.counts(num_envs))
    assert env.num_worlds == rows // spec.world.num_learners


def test_setups_with_different_numbers_of_learning_robots_play_together(make_weights):
    worlds = [WorldConfig(**SMALL, learners=0.5), WorldConfig(**(SMALL | {"robots": 6}), learners=0.5)]
    spec = EnvSpec(ENV_ID, worlds[0], tuple((world, 1.0) for world in worlds))
    assert spec.learners() == [4, 6] and spec.counts(24) == [12, 12]
    worker = RolloutWorker(RolloutSettings(spec, 24, STEPS, 2, GAMMA, 5), 0, 0)
    worker.set_weights(make_weights(spec, version=1, time_s=0.0))
    block = worker.collect(0.2)
    assert 0 < block.transitions <= block.header.env_steps < 24 * STEPS
    other = RolloutWorker(RolloutSettings(spec, 24, STEPS, 2, GAMMA, 6), 0, 0)
    state = worker.get_state()
    other.set_state(state["arrays"], state["meta"])
    np.testing.assert_array_equal(worker.collect(0.2).packed.rows, other.collect(0.2).packed.rows)
