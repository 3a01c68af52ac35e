"""M_sensor: counts of robots in sectors around the learning robot (Chapter 3).

Two sensing regions, the disc of radius R1 and the ring from R1 to R2, are cut into q sectors
(Figure 3.1). The state is, per region and sector, the number of own-group robots less the number of
other-group robots (3.2.1). Sectors and headings are in the world frame. Of ours are `sensor_counts =
separate`, which puts the two counts apart, and `sector_frame = goal`, which turns sectors and headings so
that angle 0 is the direction of the own goal.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_core.config import WorldConfig
from sim_core.jit import kernel
from sim_core.methods.base import Method
from sim_core.methods.headings import heading_velocities, write_headings
from sim_core.methods.progress import came_closer, goal_offset
from sim_core.outcomes import Outcome, end_of_step
from sim_core.packed import packed
from sim_core.state import WorldState

COUNT_LIMIT = 127
"""Counts saturate here, so that they fit int8."""

_RUNNING, _GOAL, _TIMEOUT = int(Outcome.RUNNING), int(Outcome.GOAL), int(Outcome.TIMEOUT)


class SensorParams(NamedTuple):
    """Constants of M_sensor."""

    robots: int
    sectors: int
    separate: bool
    faces_goal: bool
    inner_sq: Any
    outer_sq: Any
    outer_m: Any
    collision_sq: Any
    must_surround: bool
    horizon_steps: int
    reward_scale: float
    clock_is_step: bool
    timeout_fails: bool


def sector_edges(sectors: int) -> NDArray[np.float64]:
    """Unit vectors `[sectors, 2]` at the angles where the sectors begin, from -pi on."""
    angle = np.arange(sectors) * (2 * math.pi / sectors) - math.pi
    return np.round(np.stack([np.cos(angle), np.sin(angle)], axis=1), 15)  # so that 45 and 90 degrees are exact


@kernel
def sector_of(dx, dy, edges):
    """Sector 0..sectors-1 of the direction (dx, dy); sector 0 begins at angle -pi. `edges` as of `sector_edges`."""
    sectors = edges.shape[0]
    half = (sectors + 1) // 2  # the first edge at or above angle 0
    first, last = (half, sectors) if dy >= 0.0 else (1, half)
    sector = first - 1
    for edge in range(first, last):  # no angle is needed to see on which side of an edge a direction lies
        sector += 1 if edges[edge, 0] * dy - edges[edge, 1] * dx >= 0.0 else 0
    return sector


@kernel
def _goal_direction(state, world, robots):
    """Unit vector from the learning robot to its goal; +x where it stands on it."""
    dx, dy = goal_offset(state, world, robots)
    length = np.sqrt(dx * dx + dy * dy)
    if length == 0.0:
        return np.cos(dx), dy  # (1, 0) of the positions' dtype
    return dx / length, dy / length


@kernel
def _turn_to_goal(state, out_x, out_y, params):
    for world in range(out_x.shape[0]):
        cos, sin = _goal_direction(state, world, params[0].robots)
        x, y = out_x[world], out_y[world]
        out_x[world], out_y[world] = cos * x - sin * y, sin * x + cos * y


@kernel
def _perceive(state, mask, out, edges, params):
    p = params[0]
    for world in range(mask.shape[0]):
        if not mask[world]:
            continue
        pos_x, pos_y = state.pos_x[world], state.pos_y[world]
        learner = state.learner[world]
        group_begin = learner // p.robots * p.robots
        group_end = group_begin + p.robots
        cos, sin = _goal_direction(state, world, p.robots)
        out[world, :] = 0
        for other in range(pos_x.shape[0]):
            dx, dy = pos_x[other] - pos_x[learner], pos_y[other] - pos_y[learner]
            dist_sq = dx * dx + dy * dy
            if other == learner or dist_sq >= p.outer_sq:
                continue
            if p.faces_goal:
                dx, dy = cos * dx + sin * dy, cos * dy - sin * dx
            cell = sector_of(dx, dy, edges) + (0 if dist_sq < p.inner_sq else p.sectors)
            step = 1
            if not group_begin <= other < group_end:
                cell, step = (cell + 2 * p.sectors, 1) if p.separate else (cell, -1)
            out[world, cell] = min(max(out[world, cell] + step, -COUNT_LIMIT), COUNT_LIMIT)


@kernel
def _outcome(state, out, params):
    p = params[0]
    for world in range(out.shape[0]):
        ended = end_of_step(
            state.learner[world],
            p.robots,
            state.pos_x[world],
            state.pos_y[world],
            state.goal_x[world],
            state.goal_y[world],
            p.collision_sq,
            p.outer_m,
            p.must_surround,
        )
        if ended == _RUNNING and state.steps[world] >= p.horizon_steps:
            ended = _TIMEOUT
        out[world] = ended


@kernel
def _reward(state, outcome, out, params):
    p = params[0]
    for world in range(out.shape[0]):
        closer = came_closer(state, world, p.robots)
        if outcome[world] == _RUNNING or (outcome[world] == _TIMEOUT and not p.timeout_fails):
            clock = state.steps[world] if p.clock_is_step else p.horizon_steps
            reward = p.reward_scale / clock if closer else -p.reward_scale / clock
        else:
            reward = p.reward_scale if outcome[world] == _GOAL else -p.reward_scale
        out[world] = reward
        state.episode_return[world] += reward


class SensorMethod(Method):
    """M_sensor: counts by sectors, velocity u_nn, Table 3.1's reward, lost or collision as failures."""

    observation_dtype = np.int8
    observation_limit = COUNT_LIMIT

    def __init__(self, config: WorldConfig) -> None:
        """Takes its constants from `config`."""
        separate = config.sensor_counts == "separate"
        self.observation_shape = ((4 if separate else 2) * config.sectors,)
        self._faces_goal = config.sector_frame == "goal"
        self._velocities = heading_velocities(config, np.float32)
        self._edges = sector_edges(config.sectors)
        real = np.float32
        self._params = packed(
            SensorParams(
                robots=config.robots,
                sectors=config.sectors,
                separate=separate,
                faces_goal=self._faces_goal,
                inner_sq=real(config.inner_radius_m) ** 2,
                outer_sq=real(config.outer_radius_m) ** 2,
                outer_m=real(config.outer_radius_m),
                collision_sq=real(2 * config.robot_radius_m) ** 2,
                must_surround=config.captured_is == "surrounded",
                horizon_steps=config.horizon_steps,
                reward_scale=float(config.reward_scale),
                clock_is_step=config.reward_clock == "step",
                timeout_fails=config.timeout_fails,
            )
        )

    def velocity(self, state: WorldState, action: NDArray[np.int64], out_x: Any, out_y: Any) -> None:
        """Eq. 3.4: constant speed towards the chosen sector's centre, in the frame of the sectors.

        Raises:
          ValueError: there is not one action a world, or one is none of the actions.
        """
        write_headings(self._velocities, action, out_x, out_y)
        if self._faces_goal:
            _turn_to_goal(state, out_x, out_y, self._params)

    def perceive(self, state: WorldState, mask: NDArray[np.bool_], out: NDArray[np.int8]) -> None:
        """3.2.1: `[num_worlds, 2q]` counts, the inner disc's q first; apart, 2q of the own group, then 2q of others."""
        _perceive(state, mask, out, self._edges, self._params)

    def outcome(self, state: WorldState, out: NDArray[np.int8]) -> None:
        """3.2.1: goal, collision, lost or captured; timeout at the horizon."""
        _outcome(state, out, self._params)

    def reward(self, state: WorldState, outcome: NDArray[np.int8], out: NDArray[np.float32]) -> None:
        """Table 3.1, with the robot's own distance to the goal as "closer"; a timeout that is no failure is a step."""
        _reward(state, outcome, out, self._params)
