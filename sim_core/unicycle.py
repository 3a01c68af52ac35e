"""A unicycle in the learning robot's place: it drives where it faces, and turns and speeds up within limits.

It tracks the velocity that it is asked for. In every simulator step it first turns towards it, by its turn rate at most
(to the left where it lies exactly behind), and then changes its speed towards the asked velocity's part along its new
heading, by its acceleration at most; it never drives backwards. An episode begins at rest, facing the goal. Headings
are unit vectors, so a step needs no angle (the model is that of LaValle 2006, Section 13.1.2.3).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_core.config import WorldConfig
from sim_core.jit import kernel
from sim_core.methods.progress import goal_offset
from sim_core.packed import packed
from sim_core.state import WorldState


class UnicycleParams(NamedTuple):
    """Cosine and sine of the largest turn of a simulator step, and its largest change of speed (m/s)."""

    cos_turn: float
    sin_turn: float
    speed_change: float


def unicycle_params(config: WorldConfig) -> UnicycleParams:
    """The constants of `config`."""
    turn = min(math.radians(config.turn_rate_limit_deg_s) * config.time_step_s, math.pi)
    return UnicycleParams(math.cos(turn), math.sin(turn), config.acceleration_limit_m_s2 * config.time_step_s)


@kernel
def _begin(state, mask, facing, speed):
    for row in range(mask.shape[0]):
        if mask[row]:
            dx, dy = goal_offset(state, row)
            length = max(math.sqrt(float(dx) * dx + float(dy) * dy), 1e-30)
            facing[row, 0], facing[row, 1], speed[row] = dx / length, dy / length, 0.0


@kernel
def _drive(mask, command_x, command_y, facing, speed, params):
    p = params[0]
    for row in range(mask.shape[0]):
        if not mask[row]:
            continue
        x, y = float(command_x[row]), float(command_y[row])
        ahead_x, ahead_y = facing[row, 0], facing[row, 1]
        asked, along = math.sqrt(x * x + y * y), 0.0
        if asked > 0.0:
            if ahead_x * x + ahead_y * y >= p.cos_turn * asked:
                ahead_x, ahead_y = x / asked, y / asked
            else:
                sin = p.sin_turn if ahead_x * y - ahead_y * x >= 0.0 else -p.sin_turn
                ahead_x, ahead_y = p.cos_turn * ahead_x - sin * ahead_y, sin * ahead_x + p.cos_turn * ahead_y
            along = max(ahead_x * x + ahead_y * y, 0.0)
        change = min(max(along - speed[row], -p.speed_change), p.speed_change)
        facing[row, 0], facing[row, 1], speed[row] = ahead_x, ahead_y, speed[row] + change
        command_x[row], command_y[row] = speed[row] * ahead_x, speed[row] * ahead_y


class Unicycle:
    """The unicycles of a batch of worlds, with their headings and speeds.

    Args:
      config: the world.
      num_rows: learning robots of the batch.
    """

    def __init__(self, config: WorldConfig, num_rows: int) -> None:
        self._params = packed(unicycle_params(config))
        self._facing = np.zeros((num_rows, 2))
        self._speed = np.zeros(num_rows)

    def begin(self, state: WorldState, mask: NDArray[np.bool_]) -> None:
        """Begins the episodes that have just been set up where `mask` `[num_rows]` is set."""
        _begin(state, mask, self._facing, self._speed)

    def drive(self, mask: NDArray[np.bool_], command_x: NDArray[np.float32], command_y: NDArray[np.float32]) -> None:
        """Changes velocities `[num_rows]` (m/s) that are asked for to those driven, where `mask` is set."""
        _drive(mask, command_x, command_y, self._facing, self._speed, self._params)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays that steps change, by name: headings (unit vectors) `[num_rows, 2]`, speeds (m/s) `[num_rows]`."""
        return {"unicycle_facing": self._facing, "unicycle_speed": self._speed}
