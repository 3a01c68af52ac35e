"""A scene of your own: two groups of unequal size meet in a corridor, and the learning robot closes its group's column.

shoal train --scene deploy/examples/corridor.py:Corridor --robots 12
"""

import numpy as np

from sim_core.scenes.base import Scene, Start

HALF_LENGTH_M = 5.0
SPACING_M = 0.5


class Corridor(Scene):
    """`robots` robots go east, half as many west; columns of three, jittered by 5 cm."""

    @classmethod
    def group_sizes(cls, config):
        return config.robots, max(2, config.robots // 2)

    @classmethod
    def reach_m(cls, config):
        return HALF_LENGTH_M + SPACING_M * config.robots / 3

    def place(self, uniform):
        columns = [self.column(size, uniform) for size in self.config.group_sizes]
        goal = np.array([[HALF_LENGTH_M, 0.0], [-HALF_LENGTH_M, 0.0]])
        position = np.concatenate([columns[0] * (-1.0, 1.0), columns[1]])
        return Start(position, goal, learner=self.config.group_sizes[0] - 1)

    def column(self, size, uniform):
        row, lane = np.divmod(np.arange(size), 3)
        jitter = 0.05 * (2.0 * uniform(2 * size).reshape(size, 2) - 1.0)
        return np.stack([HALF_LENGTH_M + SPACING_M * row, SPACING_M * (lane - 1)], axis=1) + jitter
