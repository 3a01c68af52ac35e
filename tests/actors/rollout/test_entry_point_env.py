"""Environments that step together by their id's vector entry point, against single environments and odd ones."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, VectorEnv

from actors.rollout.entry_point_env import EntryPointVectorEnv, foreign_rollout_env
from actors.rollout.env_guard import env_guard
from actors.rollout.env_spec import EnvSpec
from actors.rollout.foreign_env import EnvError, ForeignVectorEnv
from actors.rollout.vector_env import env_shape
from actors.rollout.worker import RolloutSettings, RolloutWorker
from actors.service.messages import transition_dtype
from sim_core.config import WorldConfig
from tests.odd_envs import Plain
from tests.packed import unpack

CARTPOLE = "CartPole-v1"


class Together(VectorEnv):
    """Three numbers, two actions, episodes of 4 steps; `odd` changes what a step from the third on answers."""

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(self, num_envs, max_episode_steps=None):
        single = Plain()
        self.num_envs, self.steps, self.total = num_envs, np.zeros(num_envs, int), 0
        self.single_observation_space, self.single_action_space = single.observation_space, single.action_space

    def reset(self, *, seed=None, options=None):
        self.rng = np.random.default_rng(seed)
        self.steps[:] = 0
        return self.look(), {}

    def look(self):
        return self.rng.uniform(-1, 1, (self.num_envs, 3)).astype(np.float32)

    def step(self, actions):
        self.total += 1
        self.steps = np.where(self.steps == 4, 0, self.steps + 1)
        answer = [self.look(), np.ones(self.num_envs), np.zeros(self.num_envs, bool), self.steps == 4, {}]
        return tuple(self.odd(answer)) if self.total > 2 else tuple(answer)

    def odd(self, answer):
        return answer


class Nan(Together):
    def odd(self, answer):
        answer[0][1, 2] = np.nan
        return answer


class HugeReward(Together):
    def odd(self, answer):
        return [answer[0], answer[1] * 1e39, *answer[2:]]


class Short(Together):
    def odd(self, answer):
        return [answer[0][:1], *answer[1:]]


class Doubles(Together):
    def odd(self, answer):
        return [answer[0].astype(np.float64), *answer[1:]]


class Flags(Together):
    def odd(self, answer):
        return [*answer[:2], np.ones(self.num_envs), *answer[3:]]


class FourValues(Together):
    def odd(self, answer):
        return answer[:4]


class Raises(Together):
    def odd(self, answer):
        raise RuntimeError("the belt is loose")


class Hangs(Together):
    def odd(self, answer):
        while True:
            pass


class SameStep(Together):
    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}


class Larger(Together):
    def __init__(self, num_envs, max_episode_steps=None):
        super().__init__(num_envs)
        self.single_observation_space = gym.spaces.Box(-2, 2, (3,), np.float32)


class Unmade(Together):
    def __init__(self, num_envs, max_episode_steps=None):
        raise ImportError("no module named 'jax'")


@pytest.fixture
def register():
    """Function: registers a vector entry point beside `Plain`; the id goes after the test."""
    env_id = "shoal-test/Together-v0"

    def put(kind):
        gym.register(env_id, entry_point=Plain, vector_entry_point=kind)
        return env_id

    yield put
    gym.registry.pop(env_id, None)


def test_each_environment_makes_the_steps_of_a_single_one():
    env, rng, ended, waited = foreign_rollout_env(CARTPOLE, 6), np.random.default_rng(0), 0, 0
    assert isinstance(env, EntryPointVectorEnv) and env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    single = gym.make(CARTPOLE).unwrapped
    single.reset(seed=0)
    before, waiting = env.reset(seed=[3])[0], np.zeros(6, bool)
    for _ in range(150):
        actions = rng.integers(2, size=6)
        after, reward, terminated, truncated, infos = env.step(actions)
        np.testing.assert_array_equal(infos["decided"], ~waiting)
        for i in range(6):
            if waiting[i]:
                assert np.abs(after[i]).max() <= 0.05 and (reward[i], terminated[i], truncated[i]) == (0, False, False)
                waited += 1
                continue
            single.state, single.steps_beyond_terminated = before[i].astype(float), None
            expected, gain, ends, *_ = single.step(actions[i])
            np.testing.assert_allclose(after[i], expected, rtol=1e-5, atol=1e-6)
            assert (gain, ends) == (reward[i], terminated[i])
        waiting, before = terminated | truncated, after
        np.testing.assert_array_equal(env.waiting(), waiting)
        if waiting.any():
            np.testing.assert_array_equal(infos["final_obs"][waiting], after[waiting])
        ended += waiting.sum()
    assert ended >= waited >= ended - 6 and waited > 20


def test_one_seed_gives_all_first_states():
    env = foreign_rollout_env(CARTPOLE, 4)
    first, again, other = (env.reset(seed=[seed])[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).all() and len(np.unique(first)) == first.size


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        (Nan, r"at its step 3: it gave an observation with nan, which is not finite"),
        (HugeReward, r"at its step 3: step\(\) gave the reward 1e\+39, which is not finite in float32"),
        (Short, r"at its step 3: step\(\) gave the observations array.*, where there must be numbers \(2, 3\)"),
        (Doubles, r"at its step 3: step\(\) gave observations of dtype float64, where there must be float32"),
        (Flags, r"at its step 3: step\(\) gave flags of dtype float64, where there must be bool"),
        (FourValues, r"at its step 3: step\(\) gave .* of Gymnasium has 5 values"),
        (
            Raises,
            r"at its step 3: step\(\) raised RuntimeError: the belt is loose \(test_entry_point_env.py, line",
        ),
        (Hangs, r"at its step 3: step\(\) has not come back"),
    ],
)
def test_what_it_must_not_do_is_named(register, kind, words):
    env = foreign_rollout_env(register(kind), 2)
    env.reset(seed=[0])
    with env_guard(0.2), pytest.raises(EnvError, match=words):
        for _ in range(3):
            env.step(np.zeros(2, np.int64))


@pytest.mark.parametrize("kind", [SameStep, Larger, Unmade, None])
def test_others_step_one_after_the_other(register, kind, caplog):
    with caplog.at_level("INFO"):
        assert isinstance(foreign_rollout_env(register(kind), 2), ForeignVectorEnv)
    assert "one after the other, since" in caplog.text


def test_transitions_and_episodes_of_a_worker(register, make_weights):
    """No transition begins in the step that starts an episode, and episodes have 4 steps and a return of 4."""
    spec = EnvSpec(register(Together), WorldConfig())
    worker = RolloutWorker(RolloutSettings(spec, 5, 13, 2, 0.5, 7), 0, 0)
    worker.set_weights(make_weights(spec))
    blocks = [worker.collect(1.0) for _ in range(4)]
    dtype = transition_dtype(env_shape(spec).observation_space)
    rows = np.concatenate([unpack(block.packed, dtype) for block in blocks])
    stats = [block.episodes for block in blocks]
    assert set(np.concatenate([each.length_steps for each in stats])) == {4}
    assert set(np.concatenate([each.episode_return for each in stats])) == {4.0}
    assert sum(block.header.env_steps for block in blocks) == 5 * 4 * 13 - 5 * (4 * 13 // 5)
    assert set(rows["reward"]) == {1.5, 1.0}  # the last transition of an episode has one step
    assert (rows["discount"] == np.where(rows["reward"] == 1.5, 0.25, 0.5)).all()  # a timeout is no terminal


def test_the_transitions_of_cart_pole_are_steps_of_its_dynamics(make_weights):
    spec = EnvSpec(CARTPOLE, WorldConfig())
    worker = RolloutWorker(RolloutSettings(spec, 8, 100, 1, 0.9, 7), 0, 0)
    worker.set_weights(make_weights(spec))
    dtype = transition_dtype(env_shape(spec).observation_space)
    rows = unpack(worker.collect(1.0).packed, dtype)
    single = gym.make(CARTPOLE).unwrapped
    single.reset(seed=0)
    assert len(rows) > 700 and 10 < (rows["discount"] == 0).sum() < 80
    for row in rows:
        single.state, single.steps_beyond_terminated = row["observation"].astype(float), None
        expected, gain, ends, *_ = single.step(int(row["action"]))
        np.testing.assert_allclose(row["next_observation"], expected, rtol=1e-5, atol=1e-6)
        assert (row["reward"], row["discount"]) == (gain, np.float32(0.0 if ends else 0.9))
