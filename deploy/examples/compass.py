"""A method of your own in plain numpy: where the own group's centre is, and the nearest robot of another group.

shoal train --method deploy/examples/compass.py:Compass
"""

import numpy as np

from sim_core.methods.base import Method


class Compass(Method):
    """Two offsets in metres, cut at R2; headings, reward and outcome are M_sensor's."""

    swarm_knows_learner = True
    fits_any_groups = True

    @classmethod
    def observation_names(cls, config):
        return "x of the group", "y of the group", "x of the nearest other", "y of the nearest other"

    @classmethod
    def rules(cls, config):
        headings = cls(config).headings[: config.sectors]
        return {"greedy": lambda observation: np.argmax(observation[:, :2] @ headings.T, axis=1)}

    def observe(self, state):
        learner = state.learner[:, None]
        dx = state.pos_x - np.take_along_axis(state.pos_x, learner, axis=1)  # [num_worlds, num_robots]
        dy = state.pos_y - np.take_along_axis(state.pos_y, learner, axis=1)
        own, known = state.group == state.group[learner], np.isfinite(dx)  # a robot that is not sensed is at NaN
        dx, dy = np.where(known, dx, 0.0), np.where(known, dy, 0.0)
        near = np.where(own | ~known, np.inf, dx * dx + dy * dy).argmin(axis=1)[:, None]
        own &= known
        x = [np.mean(dx, axis=1, where=own), np.take_along_axis(dx, near, axis=1)[:, 0]]
        y = [np.mean(dy, axis=1, where=own), np.take_along_axis(dy, near, axis=1)[:, 0]]
        limit = self.config.outer_radius_m
        return np.clip(np.stack([x[0], y[0], x[1], y[1]], axis=1), -limit, limit)
