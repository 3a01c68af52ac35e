"""The Gymnasium environments: outside checkers, and the batch against its single environments."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from sim_core import ENV_ID
from sim_core.checks import ConfigError
from sim_core.envs import SwarmEnv, SwarmVectorEnv
from sim_core.outcomes import Outcome

SETTINGS = {"robots": 4, "groups": 2, "arena_radius_m": 2.0, "horizon_steps": 60}
ENDS = {Outcome.GOAL, Outcome.LOST, Outcome.CAPTURED, Outcome.COLLISION}


@pytest.mark.parametrize(
    "settings", [{}, SETTINGS, {"sectors": 5, "stop_action": True}, {"method": "in"}, SETTINGS | {"method": "out"}]
)
def test_gymnasium_finds_nothing_to_complain_about(settings):
    check_env(gym.make(ENV_ID, render_mode="rgb_array", **settings).unwrapped)


@pytest.mark.parametrize("method", ["sensor", "in", "out"])
@pytest.mark.parametrize("num_envs", [1, 5])
@pytest.mark.parametrize("seed", [0, 17, 2**31 - 9])
def test_the_batch_equals_its_single_environments(num_envs, seed, method):
    settings = SETTINGS | {"method": method, "outside_limit_steps": 30}
    envs, singles = SwarmVectorEnv(num_envs, **settings), [SwarmEnv(**settings) for _ in range(num_envs)]
    observation, infos = envs.reset(seed=seed)
    assert infos == {}
    expected = [single.reset(seed=seed + i)[0] for i, single in enumerate(singles)]
    np.testing.assert_array_equal(observation, expected)
    rng, seen = np.random.default_rng(seed), set()
    for _ in range(150):
        actions = rng.integers(8, size=num_envs)
        results = [single.step(action) for single, action in zip(singles, actions, strict=True)]
        last, reward, terminated, truncated, single_infos = zip(*results, strict=True)
        done = np.array(terminated) | truncated
        first = [single.reset()[0] if done[i] else last[i] for i, single in enumerate(singles)]
        batch = envs.step(actions)
        for got, wanted in zip(batch[:4], (first, reward, terminated, truncated), strict=True):
            np.testing.assert_array_equal(got, wanted)
        assert_final(batch[4], done, last, single_infos)
        seen |= {info["outcome"] for info in single_infos}
    assert len(seen) >= (3 if num_envs == 5 else 2)


def assert_final(infos, done, last, single_infos):
    """The batch's infos say where episodes ended, in which state, and how."""
    if not done.any():
        assert infos == {}
        return
    np.testing.assert_array_equal(infos["_final_obs"], done)
    np.testing.assert_array_equal(infos["_final_info"], done)
    for i in np.flatnonzero(done):
        np.testing.assert_array_equal(infos["final_obs"][i], last[i])
        for name, value in single_infos[i].items():
            assert infos["final_info"][name][i] == value, name
    for name in ("outcome", "episode_length", "episode_return"):
        np.testing.assert_array_equal(infos["final_info"][f"_{name}"], done)


def test_infos_tell_length_return_and_outcome():
    env = SwarmEnv(**SETTINGS)
    assert env.reset(seed=1)[1] == {"outcome": Outcome.RUNNING}
    rewards, infos = [], []
    while not infos or infos[-1]["outcome"] == Outcome.RUNNING:
        _, reward, terminated, truncated, info = env.step(np.int64(3))
        rewards.append(reward)
        infos.append(info)
    assert all(info == {"outcome": Outcome.RUNNING} for info in infos[:-1])
    assert infos[-1]["episode_length"] == len(rewards)
    assert infos[-1]["episode_return"] == pytest.approx(sum(rewards), rel=1e-6)
    assert terminated != truncated


@pytest.mark.parametrize("horizon", [1, 7])
def test_the_horizon_truncates(horizon):
    envs = SwarmVectorEnv(6, horizon_steps=horizon)
    envs.reset(seed=3)
    for step in range(1, 3 * horizon + 1):
        _, _, terminated, truncated, infos = envs.step(np.arange(6))
        assert not terminated.any()  # ten robots and the defaults: nothing else can end so early
        assert truncated.all() == (step % horizon == 0) and truncated.any() == truncated.all()
    assert (infos["final_info"]["outcome"] == Outcome.TIMEOUT).all()
    assert (infos["final_info"]["episode_length"] == horizon).all()


@pytest.mark.parametrize("method", ["in", "out"])
def test_a_horizon_that_is_a_failure_terminates(method):
    settings = {"method": method, "horizon_steps": 4}
    envs, env = SwarmVectorEnv(6, **settings), SwarmEnv(**settings)
    envs.reset(seed=3)
    env.reset(seed=3)
    for step in range(1, 5):
        _, reward, terminated, truncated, infos = envs.step(np.arange(6))
        one = env.step(np.int64(0))
        assert not truncated.any() and terminated.tolist() == [step == 4] * 6
        assert one[2:4] == (step == 4, False)
    assert (infos["final_info"]["outcome"] == Outcome.TIMEOUT).all() and (reward == -1).all() and one[1] == -1
    assert SwarmEnv(horizon_is="cut", **settings).config.timeout_fails is False


def test_a_task_that_ends_at_the_horizon_is_no_timeout():
    """The env step of an outcome is the last before the cut: shorten the horizon to it."""
    env = SwarmEnv(**SETTINGS)

    def last_step(horizon):
        env = SwarmEnv(**(SETTINGS | {"horizon_steps": horizon}))
        env.reset(seed=2)
        for _ in range(horizon):
            result = env.step(np.int64(0))
            if result[2] or result[3]:
                break
        return result

    full = last_step(500)
    length = full[4]["episode_length"]
    assert full[2] and full[4]["outcome"] in ENDS and length > 2
    assert last_step(length)[2:4] == (True, False)
    assert last_step(length - 1)[2:4] == (False, True)
    env.close()


def test_seeds():
    env = SwarmEnv(**SETTINGS)
    first = env.reset(seed=5)[0], env.worlds.positions()
    later = env.reset()[0], env.worlds.positions()
    again = env.reset(seed=5)[0], env.worlds.positions()
    np.testing.assert_array_equal(first[1], again[1])
    assert not np.array_equal(first[1], later[1])
    unseeded = [SwarmEnv(**SETTINGS) for _ in range(2)]
    for other in unseeded:
        other.reset()
    assert not np.array_equal(unseeded[0].worlds.positions(), unseeded[1].worlds.positions())


def test_a_list_of_seeds_names_every_world():
    envs, single = SwarmVectorEnv(3, **SETTINGS), SwarmEnv(**SETTINGS)
    observation, _ = envs.reset(seed=[9, 4, 9])
    for i, seed in enumerate((9, 4, 9)):
        np.testing.assert_array_equal(observation[i], single.reset(seed=seed)[0])
    assert np.array_equal(envs.worlds.positions()[0], envs.worlds.positions()[2])
    for seeds in ([1, 2], [1, 2, 3, 4]):
        with pytest.raises(ValueError, match="one an environment"):
            envs.reset(seed=seeds)


def test_a_reset_without_a_seed_goes_on_with_the_streams():
    first, second = SwarmVectorEnv(2, **SETTINGS), SwarmVectorEnv(2, **SETTINGS)
    first.reset(seed=1)
    second.reset(seed=1)
    start = first.worlds.positions()
    first.reset()
    second.reset()
    np.testing.assert_array_equal(first.worlds.positions(), second.worlds.positions())
    assert not np.array_equal(first.worlds.positions(), start)


@pytest.mark.parametrize("action", [-1, 8, 1.0, 0.5, "1", None, np.array([1]), np.float32(1)])
def test_bad_actions_are_refused(action):
    env = SwarmEnv()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action"):
        env.step(action)


@pytest.mark.parametrize("actions", [[0], [0, 1, 2], [[0, 1]], [-1, 0], [0, 8], [0.0, 1.5], [True, False]])
def test_bad_action_batches_are_refused(actions):
    envs = SwarmVectorEnv(2)
    envs.reset(seed=0)
    before = envs.worlds.positions()
    with pytest.raises(ValueError, match="actions"):
        envs.step(actions)
    np.testing.assert_array_equal(envs.worlds.positions(), before)


@pytest.mark.parametrize("maker", [SwarmEnv, SwarmVectorEnv])
@pytest.mark.parametrize("settings", [{"robot": 3}, {"Robots": 3}, {"robots": 0}, {"render_mode": "human"}])
def test_bad_settings_are_refused(maker, settings):
    with pytest.raises(ConfigError, match=next(iter(settings))):
        maker(**settings)


def test_make_by_id():
    env = gym.make(ENV_ID, robots=3, groups=1, sectors=6, render_mode="rgb_array")
    assert isinstance(env.unwrapped, SwarmEnv) and env.unwrapped.config.robots == 3
    assert env.action_space.n == 6 and env.render_mode == "rgb_array"
    env.reset(seed=1)
    assert env.observation_space.contains(env.step(0)[0])
    envs = gym.make_vec(ENV_ID, num_envs=7, robots=3, groups=1, render_mode="rgb_array")
    assert isinstance(envs.unwrapped, SwarmVectorEnv) and envs.num_envs == 7
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert envs.observation_space.contains(envs.reset(seed=1)[0])
    assert envs.action_space.contains(envs.action_space.sample())


def test_images():
    env = SwarmEnv(render_mode="rgb_array", **SETTINGS)
    env.reset(seed=0)
    image = env.render()
    assert image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3
    envs = SwarmVectorEnv(2, render_mode="rgb_array", **SETTINGS)
    envs.reset(seed=0)
    images = envs.render()
    assert len(images) == 2 and np.array_equal(images[0], image) and not np.array_equal(images[1], image)
    assert SwarmEnv().render() is None and SwarmVectorEnv(2).render() is None
    assert env.metadata["render_fps"] == 20
