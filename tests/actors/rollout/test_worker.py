"""A rollout worker against environments that the test steps with the same actions."""

import json

import numpy as np
import pytest

from actors.policy.policy import Policy
from actors.rollout.vector_env import env_shape
from actors.rollout.worker import RolloutSettings, RolloutWorker, join_stats
from actors.service.messages import NO_OUTCOME, SCHEMA_VERSION, EpisodeStats, transition_dtype
from sim_core.checks import ConfigError
from sim_core.envs import SwarmVectorEnv
from sim_core.outcomes import ENDED
from tests.packed import unpack

NUM_ENVS, STEPS = 4, 20


def transitions_of(spec, blocks):
    """Unpacked transitions of all blocks."""
    dtype = transition_dtype(env_shape(spec).observation_space)
    return np.concatenate([unpack(block.packed, dtype) for block in blocks])


@pytest.fixture
def make_worker(make_weights):
    """Function: a worker of one-step transitions with random weights."""

    def make(spec, n_step=1, worker_id=3, incarnation=1, weights=True, seed=7):
        settings = RolloutSettings(spec, NUM_ENVS, STEPS, n_step, 0.9, seed)
        worker = RolloutWorker(settings, worker_id, incarnation)
        if weights:
            worker.set_weights(make_weights(spec, version=12, time_s=3.5))
        return worker

    return make


def assert_same_block(first, second):
    assert first.header == second.header._replace(made=first.header.made)  # counts from the start of the process
    for a, b in zip(first.packed, second.packed, strict=True):
        np.testing.assert_array_equal(a, b)
    for a, b in zip(first.episodes, second.episodes, strict=True):
        np.testing.assert_array_equal(a, b)


def by_hand(spec, worlds, rows):
    """Steps worlds from the state `worlds` with the actions of `rows`; returns expected columns and ended episodes."""
    env = SwarmVectorEnv(NUM_ENVS, **spec.settings)
    observation = env.worlds.set_state(worlds)
    columns, ended = [], []
    for step in rows.reshape(-1, NUM_ENVS):
        after, reward, terminated, truncated, infos = env.step(step["action"])
        done = terminated | truncated
        reached = np.where(done[:, None], infos["final_obs"], after) if done.any() else after
        columns.append((observation, reward, np.where(terminated, 0.0, 0.9), reached))
        if done.any():
            info = infos["final_info"]
            ended.append([info[name][done] for name in ("outcome", "episode_length", "episode_return")])
        observation = after
    return [np.concatenate(column) for column in zip(*columns, strict=True)], ended


def test_transitions_and_episodes_equal_those_of_the_environment(swarm, make_worker):
    worker = make_worker(swarm)
    arrays = worker.get_state()["arrays"]
    worlds = {name.removeprefix("world_"): array for name, array in arrays.items() if name.startswith("world_")}
    blocks = [worker.collect(1.0) for _ in range(4)]
    rows = transitions_of(swarm, blocks)
    expected, ended = by_hand(swarm, worlds, rows)
    for name, column in zip(("observation", "reward", "discount", "next_observation"), expected, strict=True):
        np.testing.assert_array_equal(rows[name], column.astype(rows[name].dtype), err_msg=name)
    stats = join_stats([block.episodes for block in blocks])
    outcome, length, episode_return = (np.concatenate(column) for column in zip(*ended, strict=True))
    assert len(outcome) >= 8 and set(outcome) <= set(ENDED)
    np.testing.assert_array_equal(stats.outcome, outcome)
    np.testing.assert_array_equal(stats.length_steps, length)
    np.testing.assert_allclose(stats.episode_return, episode_return, rtol=1e-6)


def test_greedy_actions_are_those_of_the_policy(swarm, make_worker, make_weights):
    rows = make_worker(swarm).collect(0.0).packed.rows
    policy = Policy(make_weights(swarm))
    np.testing.assert_array_equal(rows["action"], policy.greedy(rows["observation"]))
    assert len(set(rows["action"])) > 1


def test_the_header_holds_the_origin_of_a_block(swarm, make_worker, make_weights):
    worker = make_worker(swarm)
    first, second = worker.collect(0.25).header, worker.collect(0.125).header
    expected = (SCHEMA_VERSION, 3, 1, 0, 12, 3.5, 0.25, NUM_ENVS * STEPS, NUM_ENVS * STEPS)
    assert tuple(first) == expected
    assert second == first._replace(sequence=1, epsilon=0.125, made=2 * NUM_ENVS * STEPS)
    assert worker.policy_version == 12
    worker.set_weights(make_weights(swarm, version=13, time_s=4.0))
    assert worker.collect(0.0).header[3:6] == (2, 13, 4.0)


@pytest.mark.parametrize("n_step", [1, 3])
def test_a_restored_worker_makes_the_same_blocks(swarm, make_worker, n_step):
    worker = make_worker(swarm, n_step)
    worker.collect(0.5)
    saved = worker.get_state()
    meta = json.loads(json.dumps(saved["meta"]))
    expected = [worker.collect(0.5) for _ in range(3)]
    resumed = make_worker(swarm, n_step, weights=False, seed=99)
    resumed.set_state(saved["arrays"], meta)
    for block in expected:
        assert_same_block(resumed.collect(0.5), block)


def test_the_state_is_a_copy(swarm, make_worker):
    worker = make_worker(swarm, 3)
    saved = worker.get_state()
    kept = {name: array.copy() for name, array in saved["arrays"].items()}
    worker.collect(0.5)
    for name, array in saved["arrays"].items():
        np.testing.assert_array_equal(array, kept[name], err_msg=name)


def test_every_worker_and_every_incarnation_has_its_own_streams(swarm, make_worker):
    first = make_worker(swarm).collect(0.5)
    assert_same_block(first, make_worker(swarm).collect(0.5))
    for other in (make_worker(swarm, worker_id=4), make_worker(swarm, incarnation=2), make_worker(swarm, seed=8)):
        assert not np.array_equal(other.collect(0.5).packed.rows, first.packed.rows)


def test_an_environment_without_outcomes(cart_pole, make_worker):
    worker = make_worker(cart_pole)
    blocks = [worker.collect(1.0) for _ in range(6)]
    rows, stats = transitions_of(cart_pole, blocks), join_stats([block.episodes for block in blocks])
    assert (stats.outcome == NO_OUTCOME).all() and len(stats.outcome) >= 8
    np.testing.assert_array_equal(stats.episode_return, stats.length_steps)  # the reward is 1 per step
    fallen = rows["discount"] == 0
    assert fallen.sum() == len(stats.outcome)
    beyond = (np.abs(rows["next_observation"][:, 0]) > 2.4) | (
        np.abs(rows["next_observation"][:, 2]) > 12 * np.pi / 180
    )
    np.testing.assert_array_equal(fallen, beyond)  # final observations, not the first ones of new episodes


def test_an_environment_that_cannot_be_saved_starts_new_episodes_after_a_resume(cart_pole, make_worker):
    worker = make_worker(cart_pole, 3)
    worker.collect(0.5)
    saved = worker.get_state()
    resumed = make_worker(cart_pole, 3, incarnation=2, weights=False)
    resumed.set_state(saved["arrays"], saved["meta"])
    header = resumed.collect(0.5).header
    assert (header.sequence, header.incarnation, header.policy_version) == (1, 2, 12)


def test_collecting_without_weights_is_refused(swarm, make_worker):
    worker = make_worker(swarm, weights=False)
    assert worker.policy_version == -1
    with pytest.raises(RuntimeError, match="weights"):
        worker.collect(0.5)
    resumed = make_worker(swarm, weights=False)
    saved = worker.get_state()
    resumed.set_state(saved["arrays"], saved["meta"])
    with pytest.raises(RuntimeError, match="weights"):
        resumed.collect(0.5)


def test_a_block_shorter_than_n_steps_has_no_rows(swarm, make_worker, make_weights):
    worker = RolloutWorker(RolloutSettings(swarm, 2, 1, 5, 0.9, 0), 0, 0)
    worker.set_weights(make_weights(swarm))
    block = worker.collect(0.0)
    assert block.transitions == 0 and block.header.env_steps == 2
    assert sum(worker.collect(0.0).transitions for _ in range(60)) > 80


def test_join_stats():
    one = EpisodeStats(np.array([1], np.int8), np.array([3], np.int32), np.array([0.5]))
    two = EpisodeStats(np.array([2, 5], np.int8), np.array([4, 9], np.int32), np.array([1.5, -1.0]))
    joined = join_stats([one, two])
    assert [column.tolist() for column in joined] == [[1, 2, 5], [3, 4, 9], [0.5, 1.5, -1.0], [], []]
    assert [len(column) for column in join_stats([])] == [0, 0, 0, 0, 0]


def test_a_return_that_float32_does_not_hold_never_leaves_the_worker(swarm, make_worker):
    worker = make_worker(swarm._replace(env_id="tests.odd_envs:LargeRewards-v0"), n_step=3)
    with pytest.raises(ConfigError, match="env_id .*LargeRewards-v0' gives a 3-step return of inf"):
        worker.collect(1.0)
