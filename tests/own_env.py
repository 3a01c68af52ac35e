"""A Gymnasium environment of a user's own, made by its id `tests.own_env:Line-v0`."""

import gymnasium as gym
import numpy as np


class Line(gym.Env):
    """A point on a line; a step left or right, reward near 0, cut after 20 steps."""

    def __init__(self):
        self.observation_space = gym.spaces.Box(-30, 30, (1,), np.float32)
        self.action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.steps = float(self.np_random.uniform(-5, 5)), 0
        return np.array([self.place], np.float32), {}

    def step(self, action):
        self.place += 1.0 if action else -1.0
        self.steps += 1
        return np.array([self.place], np.float32), -abs(self.place), False, self.steps >= 20, {}


gym.register("Line-v0", entry_point=Line)
