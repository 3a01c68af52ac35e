"""The arrays of a batch of worlds, as named tuples that kernels take whole."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sim_core.config import WorldConfig
from sim_core.jit import kernel


class WorldState(NamedTuple):
    """All that a batch of worlds needs to go on, as a structure of arrays.

    Shapes: pos_*, vel_* `[num_worlds, num_robots]` (metres, m/s); goal_* `[num_worlds, groups]`; steps `[num_worlds]`
    int32, simulator steps so far; rng `[num_worlds]` uint64; machine `[num_worlds, num_robots]` int8, the FL-ORCA state
    of the last step. A row for each learning robot, world after world, equally many a world (`world_of`): learner
    `[num_rows]` int32, the robot; outside_steps `[num_rows]` int32, the last steps outside the own ellipse, one after
    the other; goal_distance_m `[num_rows]`, before the step; episode_return `[num_rows]` float64. With one learning
    robot a world, which is the default, a row is a world. Alike in all worlds and never changed: group `[num_robots]`
    int32, each robot's group; group_begin `[groups + 1]` int32, the first robot of each group, then num_robots.
    """

    pos_x: Any
    pos_y: Any
    vel_x: Any
    vel_y: Any
    goal_x: Any
    goal_y: Any
    learner: Any
    steps: Any
    outside_steps: Any
    goal_distance_m: Any
    episode_return: Any
    rng: Any
    machine: Any
    group: Any
    group_begin: Any


CONSTANT = ("group", "group_begin")
"""Arrays that the settings decide; no checkpoint holds them."""
PER_ROW = ("learner", "outside_steps", "goal_distance_m", "episode_return")
"""Arrays with one entry a learning robot."""


@kernel
def learners_per_world(state):
    """Learning robots of a world: rows of one world, one after the other."""
    return state.learner.shape[0] // state.pos_x.shape[0]


@kernel
def world_of(state, row):
    """The world of a row."""
    return row // learners_per_world(state)


@kernel
def own_group(state, row):
    """(group, begin, end): the group of a row's learning robot, whose robots are begin..end-1."""
    group = state.group[state.learner[row]]
    return group, state.group_begin[group], state.group_begin[group + 1]


def empty_state(config: WorldConfig, num_worlds: int, dtype: Any) -> WorldState:
    """Zeroed arrays for `num_worlds` worlds of `config`; positions are of `dtype`."""
    robots, groups = (num_worlds, config.num_robots), (num_worlds, config.groups)
    num_rows = num_worlds * config.num_learners
    return WorldState(
        pos_x=np.zeros(robots, dtype),
        pos_y=np.zeros(robots, dtype),
        vel_x=np.zeros(robots, dtype),
        vel_y=np.zeros(robots, dtype),
        goal_x=np.zeros(groups, dtype),
        goal_y=np.zeros(groups, dtype),
        learner=np.zeros(num_rows, np.int32),
        steps=np.zeros(num_worlds, np.int32),
        outside_steps=np.zeros(num_rows, np.int32),
        goal_distance_m=np.zeros(num_rows, dtype),
        episode_return=np.zeros(num_rows, np.float64),
        rng=np.zeros(num_worlds, np.uint64),
        machine=np.zeros(robots, np.int8),
        group=np.repeat(np.arange(config.groups, dtype=np.int32), config.group_sizes),
        group_begin=np.concatenate([[0], np.cumsum(config.group_sizes)]).astype(np.int32),
    )
