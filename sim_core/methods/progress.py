"""Progress of the learning robot itself towards its goal, which step rewards speak of."""

from __future__ import annotations

import numpy as np

from sim_core.jit import kernel


@kernel
def came_closer(state, world, robots):
    """Whether the step brought a world's learning robot closer to its group's goal; remembers the new distance."""
    learner = state.learner[world]
    group = learner // robots
    dx = state.pos_x[world, learner] - state.goal_x[world, group]
    dy = state.pos_y[world, learner] - state.goal_y[world, group]
    distance_m = np.sqrt(dx * dx + dy * dy)
    closer = distance_m < state.goal_distance_m[world]
    state.goal_distance_m[world] = distance_m
    return closer
