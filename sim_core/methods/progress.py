"""The learning robot and its goal: where it lies, and whether a step came closer, which step rewards speak of."""

from __future__ import annotations

import numpy as np

from sim_core.jit import kernel
from sim_core.state import own_group


@kernel
def goal_offset(state, world):
    """(dx, dy) in metres from a world's learning robot to its group's goal."""
    learner = state.learner[world]
    group, _, _ = own_group(state, world)
    dx = state.goal_x[world, group] - state.pos_x[world, learner]
    dy = state.goal_y[world, group] - state.pos_y[world, learner]
    return dx, dy


@kernel
def came_closer(state, world):
    """Whether the step brought a world's learning robot closer to its group's goal; remembers the new distance."""
    dx, dy = goal_offset(state, world)
    distance_m = np.sqrt(dx * dx + dy * dy)
    closer = distance_m < state.goal_distance_m[world]
    state.goal_distance_m[world] = distance_m
    return closer
