"""The action space that all methods share: q headings at constant speed (Eq. 3.3 and 3.4), or at several speeds."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_core.config import WorldConfig
from sim_core.jit import kernel


def heading_velocities(config: WorldConfig, dtype: Any) -> NDArray[Any]:
    """Velocity of every action `[num_actions, 2]`, m/s (Eq. 3.3 and 3.4).

    Action a in 0..q-1 moves towards the centre of sector a. The text counts a from 1 to q+1, of which the
    last repeats the first heading. With several speeds the q headings follow once more for each lower speed, the next
    lower one first. A stop action, if there is one, comes last.
    """
    q, levels = config.sectors, config.speed_levels
    alpha = math.pi / q + np.arange(q) * (2 * math.pi / q) - math.pi
    heading = np.stack([np.cos(alpha), np.sin(alpha)], axis=1)
    velocity = np.concatenate([config.learner_speed_m_s * level / levels * heading for level in range(levels, 0, -1)])
    if config.stop_action:
        velocity = np.concatenate([velocity, np.zeros((1, 2))])
    return velocity.astype(dtype)


@kernel
def _write_headings(table, action, out_x, out_y):
    for row in range(action.shape[0]):
        if action[row] < 0 or action[row] >= table.shape[0]:
            raise ValueError("action must be in 0..num_actions - 1")
        out_x[row] = table[action[row], 0]
        out_y[row] = table[action[row], 1]


@kernel
def turn_headings(action, parts, step, sectors, levels):
    """Turns actions `[batch]` in place by `parts` `[batch]` times `step` of the `sectors`; a stop stays."""
    for i in range(action.shape[0]):
        if action[i] < sectors * levels:
            heading = action[i] % sectors
            action[i] += (heading + parts[i] * step) % sectors - heading


def write_headings(table: NDArray[Any], action: NDArray[np.int64], out_x: Any, out_y: Any) -> None:
    """Writes u_nn `[num_rows]` (m/s): `table[action]` of `table` `[num_actions, 2]`.

    Raises:
      ValueError: there is not one action a learning robot, or one is none of the actions.
    """
    if action.shape != out_x.shape:
        raise ValueError(f"action must have the shape {out_x.shape}, one a learning robot, not {action.shape}")
    _write_headings(table, action, out_x, out_y)
