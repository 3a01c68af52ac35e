"""The vector environment beside Gymnasium's own: resets, seeds, options, and wrappers of gymnasium.wrappers.vector."""

import importlib.util
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import DependencyNotInstalled
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import RecordVideo
from gymnasium.wrappers import vector as wrappers

from actors.rollout.joined_env import JoinedVectorEnv
from sim_core import ENV_ID
from sim_core.checks import ConfigError
from sim_core.config import WorldConfig
from sim_core.envs import SwarmEnv, SwarmVectorEnv

SETTINGS = {"robots": 4, "groups": 2, "arena_radius_m": 2.0, "horizon_steps": 40}
NUM_ENVS, NUM_STEPS = 4, 130


SAME_STEP, NEXT_STEP, DISABLED = AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED


def ours(mode=SAME_STEP):
    return gym.make_vec(ENV_ID, num_envs=NUM_ENVS, autoreset_mode=mode, **SETTINGS)


def joined():
    """Two environments that are one, as a training of several setups has them."""
    return JoinedVectorEnv([SwarmVectorEnv(1, **SETTINGS), SwarmVectorEnv(NUM_ENVS - 1, **SETTINGS)])


def gymnasiums(mode=SAME_STEP):
    kwargs = {"autoreset_mode": mode}
    return gym.make_vec(ENV_ID, num_envs=NUM_ENVS, vectorization_mode="sync", vector_kwargs=kwargs, **SETTINGS)


def mask(*worlds):
    return np.isin(np.arange(NUM_ENVS), worlds)


def step_both(mine, theirs, rng, steps):
    for _ in range(steps):
        actions = rng.integers(8, size=NUM_ENVS)
        got, wanted = mine.step(actions), theirs.step(actions)
        for one, other in zip(got[:4], wanted[:4], strict=True):
            np.testing.assert_array_equal(one, other)
    return got, wanted


@pytest.mark.parametrize("make", [ours, joined])
def test_resets_with_masks_and_seeds_do_what_gymnasiums_do(make):
    mine, theirs, rng = make(), gymnasiums(), np.random.default_rng(0)
    resets = [
        (7, None),
        (None, mask(1)),
        (None, mask(0, 2, 3)),
        (None, mask(0, 1, 2, 3)),
        ([1, None, 2, None], None),
        ([5, 6, None, 9], mask(1, 2)),
        (11, mask(3)),
        (None, None),
        ([np.int64(3), np.uint8(4), 5, None], None),
    ]
    for seed, starts in resets:
        options = [None if starts is None else {"reset_mask": starts.copy()} for _ in range(2)]
        np.testing.assert_array_equal(
            mine.reset(seed=seed, options=options[0])[0], theirs.reset(seed=seed, options=options[1])[0]
        )
        step_both(mine, theirs, rng, 25)
        assert options[0] is None or list(options[0]) == ["reset_mask"]  # the caller's own, which wrappers read, too


@pytest.mark.parametrize("seed", [3, np.int64(3), np.uint32(3), np.array([3, 4, 5, 6]), (3, 4, 5, 6), np.int64(2**40)])
@pytest.mark.parametrize("make", [ours, joined])
def test_numpys_integers_are_seeds(make, seed):
    plain = seed.tolist() if isinstance(seed, np.ndarray | np.generic) else seed
    np.testing.assert_array_equal(make().reset(seed=seed)[0], make().reset(seed=plain)[0])
    single = SwarmEnv(**SETTINGS)
    first = plain if isinstance(plain, int) else plain[0]
    np.testing.assert_array_equal(single.reset(seed=np.int64(first))[0], make().reset(seed=seed)[0][0])


def test_worlds_without_a_seed_are_drawn_at_random_at_first():
    first, second = ours(), ours()
    first.reset(seed=[1, None, None, 2])
    second.reset(seed=[1, None, None, 2])
    one, other = (env.unwrapped.worlds.positions() for env in (first, second))
    assert [np.array_equal(one[world], other[world]) for world in range(NUM_ENVS)] == [True, False, False, True]
    assert not np.array_equal(one[1], one[2])


REFUSED = [
    {"seed": [1, 2]},
    {"seed": [1, 2, 3, 4, 5]},
    {"seed": -1},
    {"seed": [1, 2, 3, -4]},
    {"seed": [1, 2, 3, 4.0]},
    {"seed": ["1", 2, 3, 4]},
    {"options": {"reset_mask": [True] * NUM_ENVS}},
    {"options": {"reset_mask": np.ones(NUM_ENVS)}},
    {"options": {"reset_mask": np.ones(NUM_ENVS + 1, bool)}},
    {"options": {"reset_mask": np.zeros(NUM_ENVS, bool)}},
    {"options": {"mask": mask(0)}},
    {"options": {"reset_mask": mask(0), "start": 3}},
]


@pytest.mark.parametrize("arguments", REFUSED)
@pytest.mark.parametrize("make", [ours, joined])
def test_what_cannot_be_meant_is_refused_and_changes_nothing(make, arguments):
    mine, untouched = make(), make()
    for each in (mine, untouched):
        each.reset(seed=1)
    with pytest.raises(ValueError, match=r"seed|reset_mask|option"):
        mine.reset(**arguments)
    np.testing.assert_array_equal(mine.reset()[0], untouched.reset()[0])


def test_a_mask_cannot_leave_out_worlds_that_have_not_begun():
    with pytest.raises(ValueError, match="the first reset must start every world"):
        ours().reset(options={"reset_mask": mask(1)})
    env = ours()
    env.reset(seed=1)
    later = SwarmVectorEnv(NUM_ENVS, **SETTINGS)
    seen = later.set_state(env.unwrapped.get_state())
    assert np.array_equal(later.reset(options={"reset_mask": mask(1)})[0][[0, 2, 3]], seen[[0, 2, 3]])


@pytest.mark.parametrize("arguments", [{"seed": -1}, {"seed": 1.0}, {"options": {"reset_mask": mask(0)}}])
def test_the_single_environment_refuses_them_too(arguments):
    with pytest.raises(ValueError, match=r"seed|no option"):
        SwarmEnv(**SETTINGS).reset(**arguments)
    SwarmEnv(**SETTINGS).reset(options={})


@pytest.mark.parametrize("num_envs", [0, -3, 2.0, "2", None])
def test_an_impossible_number_of_environments_is_refused(num_envs):
    with pytest.raises(ConfigError, match="num_envs must be a whole number of at least 1"):
        SwarmVectorEnv(num_envs)


def test_numpys_scalars_are_settings():
    plain = WorldConfig(robots=5, time_step_s=0.0625, stop_action=True, method="in", scene="circle")
    numpys = {
        "robots": np.int64(5),
        "time_step_s": np.float32(0.0625),
        "stop_action": np.True_,
        "method": np.str_("in"),
    }
    made = WorldConfig(**numpys)
    assert made == plain and hash(made) == hash(plain)
    assert [type(getattr(made, name)) for name in numpys] == [int, float, bool, str]
    assert SwarmVectorEnv(np.int64(2), **numpys).num_envs == 2
    for name, value in {"robots": np.float64(5.0), "stop_action": np.int8(1), "time_step_s": np.float32("nan")}.items():
        with pytest.raises(ConfigError, match=name):
            WorldConfig(**{name: value})


def test_worlds_restart_when_gymnasiums_do():
    for mode in (SAME_STEP, NEXT_STEP, DISABLED):
        mine, theirs, rng, ends = ours(mode), gymnasiums(mode), np.random.default_rng(4), 0
        assert mine.metadata["autoreset_mode"] is mode
        np.testing.assert_array_equal(mine.reset(seed=2)[0], theirs.reset(seed=2)[0])
        for step in range(NUM_STEPS):
            (*_, terminated, truncated, infos), wanted = step_both(mine, theirs, rng, 1)
            done = terminated | truncated
            ends += done.sum()
            if mode is not SAME_STEP and done.any():
                for name in ("outcome", "episode_length", "episode_return"):
                    np.testing.assert_array_equal(infos[f"_{name}"], done)
                    np.testing.assert_allclose(infos[name][done], wanted[4][name][done], rtol=1e-6)
            if mode is DISABLED and done.any():
                with pytest.raises(ValueError, match="have ended; reset them with reset_mask"):
                    mine.step(np.zeros(NUM_ENVS, np.int64))
                first = [env.reset(options={"reset_mask": done.copy()})[0] for env in (mine, theirs)]
                np.testing.assert_array_equal(*first)
            if step == 70 and mode is NEXT_STEP:
                saved = mine.unwrapped.get_state()
                mine = ours(mode).unwrapped
                mine.set_state(saved)
        assert ends > 8


def test_an_unknown_mode_is_refused():
    with pytest.raises(ConfigError, match="autoreset_mode must be one of"):
        ours("sometimes")


def ends_of(env):
    """(step, world, return, length) of all episodes that a statistics wrapper and `final_info` name, in both orders."""
    rng, named, told = np.random.default_rng(1), [], []
    env.reset(seed=5)
    for step in range(NUM_STEPS):
        if step == 30:
            env.reset(options={"reset_mask": mask(0, 3)})
        infos = env.step(rng.integers(8, size=NUM_ENVS))[4]
        for world in np.flatnonzero(infos.get("_episode", [])):
            named.append((step, world, infos["episode"]["r"][world], infos["episode"]["l"][world]))
        final = infos.get("final_info", infos)
        for world in np.flatnonzero(final.get("_episode_return", [])):
            told.append((step, world, final["episode_return"][world], final["episode_length"][world]))
    return named, told


@pytest.mark.parametrize("mode", [SAME_STEP, NEXT_STEP])
def test_record_episode_statistics_gives_the_numbers_of_final_info(mode):
    named, told = ends_of(wrappers.RecordEpisodeStatistics(ours(mode)))
    assert len(told) > 8
    np.testing.assert_allclose(named, told, rtol=1e-6, atol=1e-6)  # returns are sums of float32


WRAPPERS = {
    "TransformObservation": lambda env: wrappers.TransformObservation(env, lambda seen: 2 * seen, lambda one: 2 * one),
    "FlattenObservation": wrappers.FlattenObservation,
    "RescaleObservation": lambda env: wrappers.RescaleObservation(env, np.float32(-1), np.float32(1)),
    "NormalizeObservation": wrappers.NormalizeObservation,
    "TransformReward": lambda env: wrappers.TransformReward(env, lambda reward: 3 * reward),
    "ClipReward": lambda env: wrappers.ClipReward(env, -0.5, 0.5),
    "NormalizeReward": wrappers.NormalizeReward,
}


@pytest.mark.parametrize(
    ("name", "mode"),
    [(name, NEXT_STEP) for name in WRAPPERS] + [(name, SAME_STEP) for name in WRAPPERS if name.endswith("Reward")],
)
def test_wrappers_give_what_they_give_around_gymnasiums_own(name, mode):
    """Those of observations refuse `SAME_STEP`, around Gymnasium's own environments as well."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Gymnasium's, about precision and spaces, of either environment
        mine, theirs = WRAPPERS[name](ours(mode)), WRAPPERS[name](gymnasiums(mode))
        np.testing.assert_array_equal(mine.reset(seed=3)[0], theirs.reset(seed=3)[0])
        step_both(mine, theirs, np.random.default_rng(2), 60)


def test_infos_as_lists_name_the_episodes_that_ended():
    env, rng = wrappers.DictInfoToList(ours()), np.random.default_rng(3)
    env.reset(seed=3)
    ended = 0
    for _ in range(60):
        *_, terminated, truncated, infos = env.step(rng.integers(8, size=NUM_ENVS))
        for world, info in enumerate(infos):
            done = terminated[world] or truncated[world]
            assert ("final_info" in info) == done
            ended += done
            if done:
                assert info["final_info"].keys() == {"outcome", "episode_length", "episode_return"}
    assert ended > 2


@pytest.mark.parametrize("kind", [RecordVideo, wrappers.RecordVideo])
def test_record_video_works_or_says_what_is_missing(kind, tmp_path):
    made = gym.make(ENV_ID, render_mode="rgb_array", **SETTINGS)
    many = gym.make_vec(ENV_ID, num_envs=2, render_mode="rgb_array", **SETTINGS)
    env = made if kind is RecordVideo else many
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Gymnasium's, about the last frame of an episode
        if importlib.util.find_spec("moviepy") is None:
            with pytest.raises(DependencyNotInstalled, match="(?i)moviepy is not installed, run"):
                kind(env, str(tmp_path))
            return
        recorded = kind(env, str(tmp_path), episode_trigger=lambda episode: True)
        recorded.reset(seed=1)
        for _ in range(2 * SETTINGS["horizon_steps"]):
            if any(np.atleast_1d(recorded.step(recorded.action_space.sample())[k]).any() for k in (2, 3)):
                break
        recorded.close()
    assert next(tmp_path.glob("*.mp4")).stat().st_size > 1000
