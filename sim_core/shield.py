"""A shield: the velocity that a method asks for, projected onto ORCA's half-planes before the learning robot moves.

Each robot that the learning robot senses within R2 induces one half-plane (`sim_core.orca`), the nearest first. Radius
and horizon are smaller than the swarm's: a shield must avoid collisions, not crowds (`shield_margin_m`,
`shield_horizon_s`). The learning robot takes half of the avoidance where the swarm knows it and avoids it, too, and all
of it where the swarm does not. It drives the permitted velocity nearest to the one asked for; where no velocity is
permitted, the one that violates the half-planes least (RVO2's third linear program). A velocity that is permitted
stays, bit for bit.

Eight worlds stand in the lanes of a vector, one learning robot each.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_core.config import WorldConfig
from sim_core.jit import StateKernel, inlined, kernel
from sim_core.lanes import LANES, load, store
from sim_core.orca import ORCAParams, build_half_planes, orca_params, orca_velocity
from sim_core.packed import packed
from sim_core.state import WorldState

SPEED_MARGIN = 1.0 + 1e-5
"""Above this share of the robot's top speed a velocity is shortened; rounding is no reason to."""


class ShieldParams(NamedTuple):
    """Constants of the shield, in the worlds' dtype."""

    orca: ORCAParams
    range_sq: Any


class ShieldTile(NamedTuple):
    """Work space of eight learning robots; `n` is the number of robots of a world.

    pos_vel: `[8 n, 4]`, positions (metres) and velocities (m/s).
    robot: `[8]` int32, the learning robots' rows in `pos_vel`.
    neighbours: `[n, 8]` int32 rows in `pos_vel`, nearest first, -1 for none.
    distance_sq: `[n]`, squared metres.
    lines, projected: `[n, 4, 8]`, scratch of the linear programs.
    asked_x, asked_y: `[8]`, m/s.
    """

    pos_vel: Any
    robot: Any
    neighbours: Any
    distance_sq: Any
    lines: Any
    projected: Any
    asked_x: Any
    asked_y: Any


def shield_responsibility(config: WorldConfig) -> float:
    """The share of the avoidance that the learning robot takes: half where the swarm takes the other half, else all."""
    return 0.5 if config.learner_is_known else 1.0


def shield_params(config: WorldConfig) -> ShieldParams:
    """The constants of `config`."""
    return ShieldParams(
        orca=orca_params(
            config.robot_radius_m + config.shield_margin_m,
            config.shield_horizon_s,
            config.time_step_s,
            config.method_class.top_speed_m_s(config) * SPEED_MARGIN,
            np.float32,
            responsibility=shield_responsibility(config),
        ),
        range_sq=np.float32(config.outer_radius_m) ** 2,
    )


def shield_tile(num_robots: int) -> ShieldTile:
    """The work space for worlds of `num_robots` robots."""
    real = np.float32
    return ShieldTile(
        pos_vel=np.zeros((LANES * num_robots, 4), real),
        robot=np.zeros(LANES, np.int32),
        neighbours=np.zeros((num_robots, LANES), np.int32),
        distance_sq=np.zeros(num_robots, real),
        lines=np.zeros((num_robots, 4, LANES), real),
        projected=np.zeros((num_robots, 4, LANES), real),
        asked_x=np.zeros(LANES, real),
        asked_y=np.zeros(LANES, real),
    )


@inlined
def _put(row, world, robot, sensed, tile):
    tile.pos_vel[row, 0], tile.pos_vel[row, 1] = sensed.pos_x[world, robot], sensed.pos_y[world, robot]
    tile.pos_vel[row, 2], tile.pos_vel[row, 3] = sensed.vel_x[world, robot], sensed.vel_y[world, robot]


@inlined
def _load_world(lane, world, sensed, tile, p):
    """Puts a world's learning robot and the robots that it senses within range into a lane; returns their number."""
    num_robots, learner = sensed.pos_x.shape[1], sensed.learner[world]
    x, y = sensed.pos_x[world, learner], sensed.pos_y[world, learner]
    tile.robot[lane] = lane * num_robots + learner
    _put(lane * num_robots + learner, world, learner, sensed, tile)
    count = 0
    for robot in range(num_robots):
        dx, dy = sensed.pos_x[world, robot] - x, sensed.pos_y[world, robot] - y
        near = dx * dx + dy * dy
        if robot == learner or not near < p.range_sq:
            continue
        _put(lane * num_robots + robot, world, robot, sensed, tile)
        at = count
        while at > 0 and tile.distance_sq[at - 1] > near:
            tile.distance_sq[at] = tile.distance_sq[at - 1]
            tile.neighbours[at, lane] = tile.neighbours[at - 1, lane]
            at -= 1
        tile.distance_sq[at], tile.neighbours[at, lane] = near, lane * num_robots + robot
        count += 1
    return count


@kernel
def _project(sensed, mask, command_x, command_y, tile, params):
    p = params[0]
    num_worlds = mask.shape[0]
    for first in range(0, num_worlds, LANES):
        most = 0
        tile.neighbours[:] = -1
        for lane in range(LANES):
            world = first + lane
            tile.robot[lane], tile.asked_x[lane], tile.asked_y[lane] = 0, p.orca.zero, p.orca.zero
            if world < num_worlds and mask[world]:
                tile.asked_x[lane], tile.asked_y[lane] = command_x[world], command_y[world]
                most = max(most, _load_world(lane, world, sensed, tile, p))
        if most == 0:
            continue
        build_half_planes(load(tile.robot, 0), tile.pos_vel, tile.neighbours, 0, most, tile.lines, p.orca)
        x, y = orca_velocity(tile.lines, most, load(tile.asked_x, 0), load(tile.asked_y, 0), tile.projected, p.orca)
        store(tile.asked_x, 0, x)
        store(tile.asked_y, 0, y)
        for lane in range(min(LANES, num_worlds - first)):
            if mask[first + lane]:
                command_x[first + lane], command_y[first + lane] = tile.asked_x[lane], tile.asked_y[lane]


class Shield:
    """The shield of a batch of worlds.

    Args:
      config: the world.
    """

    def __init__(self, config: WorldConfig) -> None:
        self._project, self._tile = StateKernel(_project), shield_tile(config.num_robots)
        self._params = packed(shield_params(config))

    def project(
        self,
        sensed: WorldState,
        mask: NDArray[np.bool_],
        command_x: NDArray[np.float32],
        command_y: NDArray[np.float32],
    ) -> None:
        """Changes the velocities `[num_worlds]` (m/s) that methods ask for to permitted ones, where `mask` is set.

        Args:
          sensed: what the learning robots sense.
          mask: `[num_worlds]`.
          command_x, command_y: changed in place.
        """
        self._project(sensed, mask, command_x, command_y, self._tile, self._params)
