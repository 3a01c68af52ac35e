"""The dissertation's scene: segregated groups on a circle with antipodal goals (Section 3.1).

Group centres lie evenly on a circle, which is rotated by a random angle. Each group starts on a square grid with
jitter, and its goal is the point of the circle opposite its centre. The learning robot is drawn from all robots. All
draws come from the world's own random stream.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_core.checks import require
from sim_core.config import WorldConfig
from sim_core.jit import StateKernel, kernel
from sim_core.rng import uniform
from sim_core.scenes.base import DRAWN_MARGIN_M, GOAL_HALF_SIDE_M, Scene
from sim_core.state import WorldState


class CircleParams(NamedTuple):
    """Constants of the scene, in float64; positions are rounded when they are stored."""

    robots: int
    groups: int
    arena_radius_m: float
    spacing_m: float
    jitter_m: float


def circle_params(config: WorldConfig) -> CircleParams:
    """The constants of `config`."""
    return CircleParams(
        config.robots, config.groups, config.arena_radius_m, config.start_spacing_m, config.start_jitter_m
    )


@kernel
def start_world(world, state, s):
    """Writes start positions, zero velocities, goals and the learning robot of one world. `s`: CircleParams."""
    rotation = 2.0 * math.pi * uniform(state.rng, world)
    columns = math.ceil(math.sqrt(s.robots))
    rows = math.ceil(s.robots / columns)
    for group in range(s.groups):
        angle = rotation + 2.0 * math.pi * group / s.groups
        cos, sin = math.cos(angle), math.sin(angle)
        state.goal_x[world, group] = -s.arena_radius_m * cos
        state.goal_y[world, group] = -s.arena_radius_m * sin
        for i in range(s.robots):
            row, column = i // columns, i % columns
            along = s.arena_radius_m + (row - 0.5 * (rows - 1)) * s.spacing_m
            across = (column - 0.5 * (columns - 1)) * s.spacing_m
            along += s.jitter_m * (2.0 * uniform(state.rng, world) - 1.0)
            across += s.jitter_m * (2.0 * uniform(state.rng, world) - 1.0)
            robot = group * s.robots + i
            state.pos_x[world, robot] = along * cos - across * sin
            state.pos_y[world, robot] = along * sin + across * cos
            state.vel_x[world, robot] = 0.0
            state.vel_y[world, robot] = 0.0
    state.learner[world] = int(uniform(state.rng, world) * (s.robots * s.groups))


@kernel
def _start(state, mask, s):
    for world in range(mask.shape[0]):
        if mask[world]:
            start_world(world, state, s)


def start_grid_radius_m(config: WorldConfig) -> float:
    """Distance from a group's centre to its farthest possible start position, metres."""
    columns = math.ceil(math.sqrt(config.robots))
    rows = math.ceil(config.robots / columns)
    half_m = 0.5 * config.start_spacing_m
    return math.hypot((columns - 1) * half_m + config.start_jitter_m, (rows - 1) * half_m + config.start_jitter_m)


class CircleScene(Scene):
    """Groups of equal size that cross a circle (3.1)."""

    draws_circle = True

    def __init__(self, config: WorldConfig) -> None:
        super().__init__(config)
        self._start, self._params = StateKernel(_start), circle_params(config)

    @classmethod
    def reach_m(cls, config: WorldConfig) -> float:
        """The circle's radius and a start grid's."""
        return config.arena_radius_m + start_grid_radius_m(config)

    @classmethod
    def view_half_m(cls, config: WorldConfig) -> float:
        """Every start and every goal is inside."""
        margin_m = max(start_grid_radius_m(config) + config.robot_radius_m, GOAL_HALF_SIDE_M)
        return config.arena_radius_m + margin_m + DRAWN_MARGIN_M

    @classmethod
    def check(cls, config: WorldConfig) -> None:
        """Raises ConfigError where robots would overlap, or start lost or at their goal, or groups do not fit."""
        gap_m = config.start_spacing_m - 2 * config.start_jitter_m
        require(
            gap_m >= 2 * config.robot_radius_m,
            f"robots would overlap at the start: start_spacing_m ({config.start_spacing_m}) less twice start_jitter_m "
            f"must be at least 2 × robot_radius_m ({2 * config.robot_radius_m:.3g} m)",
        )
        require(
            math.hypot(config.start_spacing_m + 2 * config.start_jitter_m, 2 * config.start_jitter_m)
            < config.outer_radius_m,
            f"the learning robot could start lost: its next robot, start_spacing_m ({config.start_spacing_m}) away "
            f"and each shifted by start_jitter_m, must be nearer than outer_radius_m (R2 = {config.outer_radius_m})",
        )
        require(
            2 * config.arena_radius_m - start_grid_radius_m(config) > config.outer_radius_m,
            f"groups would start at their goal: arena_radius_m ({config.arena_radius_m}) must put the start "
            f"grid farther than outer_radius_m (R2 = {config.outer_radius_m}) from the goal opposite",
        )
        room_m = 2 * config.arena_radius_m * math.sin(math.pi / config.groups) if config.groups > 1 else math.inf
        need_m = 2 * (start_grid_radius_m(config) + config.robot_radius_m)
        require(
            room_m >= need_m,
            f"{config.setup} does not fit: neighbouring start grids need {need_m:.2f} m "
            f"but their centres are {room_m:.2f} m apart; raise arena_radius_m or lower robots or groups",
        )

    def start(self, state: WorldState, mask: NDArray[np.bool_]) -> None:
        """Writes positions, velocities, goals and learning robots of the worlds where `mask` `[num_worlds]` is set."""
        self._start(state, mask, self._params)
