"""The boundary to environments that are not ours, against Gymnasium's own vector environment and odd environments."""

import pickle
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import FlattenObservation

from actors.rollout.foreign_env import EnvError, ForeignVectorEnv, _are_finite, rehearse_env
from sim_core.checks import ConfigError
from tests.odd_envs import Plain

AT_ONCE = {
    "WrongShape": r"reset\(\) gave an observation of shape \(4,\), where observation_space has \(3,\)",
    "NoReward": r"at its step 1: step\(\) gave the reward None, which is no number",
    "NoFlag": r"at its step 1: step\(\) gave None where terminated and truncated must be True or False",
    "NoInfo": r"at its step 1: step\(\) gave the info None, which is no dict",
    "OldApi": r"reset\(\) gave array.*, where Gymnasium has \(observation, info\)",
    "OldStep": r"at its step 1: step\(\) gave 4 values, where Gymnasium has \(observation, reward, terminated, trunc",
    "Scalar": r"Box\(-1.0, 1.0, \(\), float32\) without a dimension; one number has the shape \(1,\)",
    "FloatBytes": r"reset\(\) gave an observation of dtype float64, where observation_space has uint8",
    "NoSpaces": r"observation_space \[3\], which is no gymnasium.Space",
    "CannotBeMade": r"cannot be made by Gymnasium: OSError: no robot at /dev/ttyUSB0 \(odd_envs.py, line \d+\)",
}
"""What a rehearsal finds, and how it says so."""
LATER = {
    "Raises": r"at its step 30: step\(\) raised RuntimeError: the gripper is stuck \(odd_envs.py, line \d+\)$",
    "Exits": r"at its step 30: step\(\) ended the process with exit code 3 \(odd_envs.py, line \d+\)",
    "NanReward": r"at its step 30: step\(\) gave the reward nan, which is not finite",
    "HugeReward": r"at its step 30: step\(\) gave the reward 1e\+39, which is not finite in float32",
    "NanObservation": r"at its step 30: it gave an observation with nan, which is not finite",
    "LateShape": r"at its step 30: step\(\) gave an observation of shape \(3, 1\), where observation_space has \(3,\)",
}
"""What only a run can find."""
ACCEPTED = ("Plain", "OwnOutcome", "Images", "Doubles", "Parts", "NeverEnds")


def play(name, steps, num_envs=3):
    """Steps an odd environment at random; returns what was observed last."""
    env = ForeignVectorEnv(f"tests.odd_envs:{name}-v0", num_envs)
    env.reset(seed=list(range(num_envs)))
    for _ in range(steps):
        observation, *_ = env.step(np.zeros(num_envs, np.int64))
    env.close()
    return observation


def test_it_is_gymnasiums_vector_environment():
    mode = {"autoreset_mode": AutoresetMode.SAME_STEP}
    theirs = gym.make_vec("CartPole-v1", num_envs=3, vectorization_mode="sync", vector_kwargs=mode)
    ours, rng, ended = ForeignVectorEnv("CartPole-v1", 3), np.random.default_rng(0), 0
    assert ours.observation_space == theirs.observation_space and ours.action_space == theirs.action_space
    np.testing.assert_array_equal(ours.reset(seed=[4, 5, 6])[0], theirs.reset(seed=[4, 5, 6])[0])
    for _ in range(150):
        actions = rng.integers(2, size=3)
        *mine, infos = ours.step(actions)
        *others, expected = theirs.step(actions)
        for a, b in zip(mine, others, strict=True):
            np.testing.assert_array_equal(a, b)
            assert a.dtype == b.dtype
        for i in np.flatnonzero(mine[2] | mine[3]):
            np.testing.assert_array_equal(infos["final_obs"][i], expected["final_obs"][i])
            ended += 1
    assert ended > 10


@pytest.mark.parametrize("name", AT_ONCE)
def test_what_can_be_seen_at_the_start_is_seen_there(name):
    with pytest.raises(EnvError, match=AT_ONCE[name]) as caught:
        rehearse_env(f"tests.odd_envs:{name}-v0")
    assert f"env_id 'tests.odd_envs:{name}-v0'" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("name", LATER)
def test_what_comes_later_names_the_step_and_the_value(name):
    rehearse_env(f"tests.odd_envs:{name}-v0")
    with pytest.raises(EnvError, match=LATER[name]) as caught:
        play(name, 60)
    assert ("Traceback" in caught.value.trace) == (name in ("Raises", "Exits"))


@pytest.mark.parametrize("name", ACCEPTED)
def test_what_is_only_unusual_is_taken(name):
    rehearse_env(f"tests.odd_envs:{name}-v0")
    observation = play(name, 60)
    assert np.isfinite(observation).all()
    wanted = {"Images": np.uint8, "Doubles": np.float64}
    assert observation.dtype == wanted.get(name, np.float32)


def test_an_error_survives_the_way_from_another_process():
    error = pickle.loads(pickle.dumps(EnvError("a sentence", "Traceback ...")))
    assert isinstance(error, ConfigError) and (str(error), error.trace) == ("a sentence", "Traceback ...")


@pytest.mark.parametrize("env_id", ["FrozenLake-v1", "Taxi-v4", "Blackjack-v1"])
def test_discrete_observations_are_one_hot(env_id):
    env, single = ForeignVectorEnv(env_id, 1), FlattenObservation(gym.make(env_id))
    assert env.single_observation_space.dtype == np.uint8
    np.testing.assert_array_equal(env.reset(seed=[3])[0], [single.reset(seed=3)[0]])
    done = False
    while not done:
        expected, _, terminated, truncated, _ = single.step(0)
        observation, *_, infos = env.step(np.zeros(1, np.int64))
        done = terminated or truncated
        np.testing.assert_array_equal(infos["final_obs"] if done else observation, [expected])


class Reuses(Plain):
    """Gives the same array every time, with other numbers."""

    def look(self):
        self.seen = getattr(self, "seen", np.zeros(3, np.float32))
        self.seen += np.float32(0.01)
        return self.seen


def test_an_array_that_the_environment_uses_again_is_copied():
    gym.register("Reuses-v0", entry_point=Reuses)
    try:
        env = ForeignVectorEnv("Reuses-v0", 1)
        first, _ = env.reset(seed=[0])
        steps = [env.step(np.zeros(1, np.int64)) for _ in range(20)]
    finally:
        gym.registry.pop("Reuses-v0")
    seen = [first[0, 0], *(step[0][0, 0] for step in steps)]
    np.testing.assert_allclose(np.diff(seen), [*[0.01] * 19, 0.02], rtol=1e-4)
    np.testing.assert_allclose(steps[-1][4]["final_obs"][0, 0], seen[-1] - 0.01, rtol=1e-4)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize("value", [0.0, -1.5, 6e4, 3e38, -3e38, 4e38, 1e300, np.inf, -np.inf, np.nan])
def test_exactly_what_float32_holds_is_finite(dtype, value, recwarn):
    with np.errstate(over="ignore"):
        values = np.array([[1.0, 2.0], [value, 0.0]], dtype)
        expected = np.isfinite(values.astype(np.float32)).all()
    assert _are_finite(values) == expected and not recwarn


BROKEN = {"broken_syntax": ("def", "SyntaxError"), "broken_import": ("1 / 0", "ZeroDivisionError")}


@pytest.mark.parametrize("module", [*BROKEN, "leaves_early"])
def test_a_module_that_cannot_be_imported_is_refused(tmp_path, monkeypatch, module):
    text, words = BROKEN.get(module, ("raise SystemExit(4)", "exit code 4"))
    (tmp_path / f"{module}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(EnvError, match=words):
        rehearse_env(f"{module}:Env-v0")
    sys.modules.pop(module, None)


def test_what_close_raises_is_not_shown(recwarn):
    class Closes(Plain):
        def close(self):
            raise RuntimeError("no")

    gym.register("Closes-v0", entry_point=Closes)
    try:
        rehearse_env("Closes-v0")
    finally:
        gym.registry.pop("Closes-v0")
    assert not recwarn
