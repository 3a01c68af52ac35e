"""Environments of a user's own that are odd or broken, as people write them: `tests.odd_envs:NAME-v0`.

Each plays well for 30 steps, longer than a rehearsal, unless its fault is one of the start.
"""

import os
import time

import gymnasium as gym
import numpy as np


class Plain(gym.Env):
    """Three random numbers, two actions, 20 steps; from its 30th step on, `bad` answers instead of `good`."""

    metadata = {"render_modes": []}

    def __init__(self):
        self.observation_space = gym.spaces.Box(-1, 1, (3,), np.float32)
        self.action_space = gym.spaces.Discrete(2)
        self.steps = self.total = 0

    def look(self):
        return self.np_random.uniform(-1, 1, 3).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.look(), {}

    def step(self, action):
        self.steps += 1
        self.total += 1
        return self.bad() if self.total >= 30 else self.good()

    def answer(self, observation=None, reward=1.0, info=None):
        seen = self.look() if observation is None else observation
        return seen, reward, False, self.steps >= 20, {} if info is None else info

    def good(self):
        return self.answer()

    bad = good


class Raises(Plain):
    def bad(self):
        raise RuntimeError("the gripper is stuck\nat the door")


class Exits(Plain):
    def bad(self):
        raise SystemExit(3)


class Leaves(Plain):
    def bad(self):
        os._exit(1)


class Sleeps(Plain):
    def bad(self):
        time.sleep(100_000)


class NanReward(Plain):
    def bad(self):
        return self.answer(reward=float("nan"))


class HugeReward(Plain):
    def bad(self):
        return self.answer(reward=1e39)


class LargeRewards(Plain):
    """Each is finite, their sum is not."""

    def good(self):
        return self.answer(reward=3e38)


class NanObservation(Plain):
    def bad(self):
        return self.answer(np.array([0, np.nan, 0], np.float32))


class WrongShape(Plain):
    def look(self):
        return np.zeros(4, np.float32)


class LateShape(Plain):
    def bad(self):
        return self.answer(np.zeros((3, 1), np.float32))


class NoReward(Plain):
    def good(self):
        return self.answer(reward=None)


class NoFlag(Plain):
    def good(self):
        return self.look(), 1.0, None, False, {}


class NoInfo(Plain):
    def good(self):
        return self.look(), 1.0, False, False, None


class OldApi(Plain):
    def reset(self, **_):
        super().reset()
        return self.look()


class OldStep(Plain):
    def good(self):
        return self.look(), 1.0, False, {}


class Scalar(Plain):
    def __init__(self):
        super().__init__()
        self.observation_space = gym.spaces.Box(-1, 1, (), np.float32)

    def look(self):
        return np.float32(self.np_random.uniform(-1, 1))


class FloatBytes(Plain):
    """Says bytes, and gives float64."""

    def __init__(self):
        super().__init__()
        self.observation_space = gym.spaces.Box(0, 255, (4, 4, 3), np.uint8)

    def look(self):
        return self.np_random.uniform(0, 255, (4, 4, 3))


class NoSpaces(Plain):
    def __init__(self):
        super().__init__()
        self.observation_space = [3]


class CannotBeMade(Plain):
    def __init__(self):
        raise OSError("no robot at /dev/ttyUSB0")


class NeverEnds(Plain):
    def answer(self, **_):
        return self.look(), 1.0, False, False, {}


class OwnOutcome(Plain):
    """Reports an `outcome` of its own, a word, and what no two environments can be joined in."""

    def good(self):
        ended = self.steps >= 20
        info = {"outcome": "success"} if ended else {"shape": np.zeros(self.total), "outcome": self.total}
        return self.answer(info=info)


class Images(Plain):
    """Small images of bytes, seen and drawn."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}

    def __init__(self, render_mode=None):
        super().__init__()
        self.render_mode = render_mode
        self.observation_space = gym.spaces.Box(0, 255, (4, 4, 3), np.uint8)

    def look(self):
        return self.np_random.integers(0, 256, (4, 4, 3), np.uint8)

    def render(self):
        return np.full((32, 48, 3), 10 * self.steps, np.uint8)


class TakesNoMode(Images):
    def __init__(self):
        super().__init__()


class CannotRender(Images):
    def render(self):
        raise NotImplementedError


class NeverDraws(Images):
    def render(self):
        time.sleep(100_000)


class DrawsNothing(Images):
    def render(self):
        return None


class DrawsText(Images):
    def render(self):
        return "A robot."


class DrawsGrey(Images):
    def render(self):
        return np.zeros((32, 48), np.uint8)


class DrawsSizes(Images):
    def render(self):
        return np.zeros((32 + self.steps, 48, 3), np.uint8)


class Doubles(Plain):
    """float64, with whole numbers as rewards and numpy's flags."""

    def __init__(self):
        super().__init__()
        self.observation_space = gym.spaces.Box(-1, 1, (3,), np.float64)

    def look(self):
        return self.np_random.uniform(-1, 1, 3)

    def answer(self, **_):
        return self.look(), np.array([2]), np.bool_(False), np.bool_(self.steps >= 20), {}


class Parts(Plain):
    """A Dict of all kinds of spaces."""

    def __init__(self):
        super().__init__()
        spaces = gym.spaces
        self.observation_space = spaces.Dict(
            {
                "camera": spaces.Box(0, 255, (2, 2), np.uint8),
                "floor": spaces.Discrete(4, start=2),
                "joints": spaces.Tuple((spaces.Box(-1, 1, (2,), np.float32), spaces.MultiBinary(3))),
                "switches": spaces.MultiDiscrete([2, 3]),
            }
        )

    def look(self):
        return self.observation_space.sample()


KINDS = [kind for kind in list(globals().values()) if isinstance(kind, type) and issubclass(kind, Plain)]
for _kind in KINDS:
    gym.register(f"{_kind.__name__}-v0", entry_point=_kind)
