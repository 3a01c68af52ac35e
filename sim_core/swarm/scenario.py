"""Start positions and goals: segregated groups on a circle, goals antipodal (spec of the task, 3.1).

Group centres lie evenly on a circle, the whole scene turned by a random angle; each group is a square
grid with jitter; each group's goal is the point opposite its centre. One robot of all is drawn as the
learning robot. Everything is drawn from the world's own random stream.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim_core.config import WorldConfig
from sim_core.jit import kernel
from sim_core.rng import uniform


class ScenarioParams(NamedTuple):
    """Constants of the start scene (float64; positions are rounded when stored)."""

    robots: int
    groups: int
    arena_radius_m: float
    spacing_m: float
    jitter_m: float


def scenario_params(config: WorldConfig) -> ScenarioParams:
    """The start scene's constants of `config`."""
    return ScenarioParams(
        config.robots, config.groups, config.arena_radius_m, config.start_spacing_m, config.start_jitter_m
    )


@kernel
def start_world(world, pos_x, pos_y, vel_x, vel_y, goal_x, goal_y, learner, rng, s):
    """Writes a fresh start of one world.

    Args:
      world: index of the world.
      pos_x, pos_y, vel_x, vel_y: `[num_worlds, num_robots]`, written; robot i is of group i // robots.
      goal_x, goal_y: `[num_worlds, groups]`, written.
      learner: `[num_worlds]` int32, written.
      rng: `[num_worlds]` uint64, moved on.
      s: ScenarioParams.
    """
    turn = 2.0 * math.pi * uniform(rng, world)
    columns = math.ceil(math.sqrt(s.robots))
    rows = math.ceil(s.robots / columns)
    for group in range(s.groups):
        angle = turn + 2.0 * math.pi * group / s.groups
        cos, sin = math.cos(angle), math.sin(angle)
        goal_x[world, group] = -s.arena_radius_m * cos
        goal_y[world, group] = -s.arena_radius_m * sin
        for i in range(s.robots):
            row, column = i // columns, i % columns
            along = s.arena_radius_m + (row - 0.5 * (rows - 1)) * s.spacing_m
            across = (column - 0.5 * (columns - 1)) * s.spacing_m
            along += s.jitter_m * (2.0 * uniform(rng, world) - 1.0)
            across += s.jitter_m * (2.0 * uniform(rng, world) - 1.0)
            robot = group * s.robots + i
            pos_x[world, robot] = along * cos - across * sin
            pos_y[world, robot] = along * sin + across * cos
            vel_x[world, robot] = 0.0
            vel_y[world, robot] = 0.0
    learner[world] = int(uniform(rng, world) * (s.robots * s.groups))
