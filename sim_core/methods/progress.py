"""The learning robot and its goal: where it lies, and whether a step came closer, which step rewards speak of."""

from __future__ import annotations

import numpy as np

from sim_core.jit import kernel
from sim_core.state import own_group, world_of


@kernel
def goal_offset(state, row):
    """(dx, dy) in metres from a row's learning robot to its group's goal."""
    world, learner = world_of(state, row), state.learner[row]
    group, _, _ = own_group(state, row)
    dx = state.goal_x[world, group] - state.pos_x[world, learner]
    dy = state.goal_y[world, group] - state.pos_y[world, learner]
    return dx, dy


@kernel
def came_closer(state, row):
    """Whether the step brought a row's learning robot closer to its group's goal; remembers the new distance."""
    dx, dy = goal_offset(state, row)
    distance_m = np.sqrt(dx * dx + dy * dy)
    closer = distance_m < state.goal_distance_m[row]
    state.goal_distance_m[row] = distance_m
    return closer
