"""Measures of a world as a whole, beside each learning robot's own outcome."""

from __future__ import annotations

from typing import Any

import numpy as np

from sim_core.jit import inlined, kernel
from sim_core.outcomes import Outcome
from sim_core.state import world_of

_COLLISION = int(Outcome.COLLISION)


@inlined
def _mean_distance_m(first, second, state, world):
    """d_XY of Eq. 3.1: mean distance of the robots of two groups, which may be one, metres; NaN where a group is gone.

    Pairs i = j count, as printed; robots at NaN have left the world and do not.
    """
    pos_x, pos_y, total, count = state.pos_x[world], state.pos_y[world], 0.0, 0
    for i in range(state.group_begin[first], state.group_begin[first + 1]):
        for j in range(state.group_begin[second], state.group_begin[second + 1]):
            dx, dy = np.float64(pos_x[i] - pos_x[j]), np.float64(pos_y[i] - pos_y[j])
            distance_m = np.sqrt(dx * dx + dy * dy)
            if distance_m == distance_m:
                total, count = total + distance_m, count + 1
    return total / count


@kernel
def segregated_fraction(state, spread_m, out):
    """Writes the fraction of the pairs of groups X != Y that are segregated: d_XX < d_XY and d_YY < d_XY (Eq. 3.1).

    A pair with a group that has left the world does not count; with no pair at all the fraction is 1.

    Args:
      state: WorldState.
      spread_m: `[groups]` float64, scratch.
      out: `[num_worlds]` float64, written.
    """
    groups = spread_m.shape[0]
    for world in range(out.shape[0]):
        segregated, pairs = 0, 0
        for group in range(groups):
            spread_m[group] = _mean_distance_m(group, group, state, world)
        for first in range(groups):
            for second in range(first + 1, groups):
                apart_m = _mean_distance_m(first, second, state, world)
                if apart_m == apart_m:
                    segregated += spread_m[first] < apart_m and spread_m[second] < apart_m
                    pairs += 1
        out[world] = segregated / pairs if pairs > 0 else 1.0


@kernel
def mark_learner_collisions(state: Any, running: Any, outcome: Any, distance_sq: Any, out: Any) -> None:
    """Sets `out` `[num_rows]` where a row's robot has just collided with another running learning robot.

    Args:
      state: WorldState.
      running: `[num_rows]` bool, rows whose episode went on before this step.
      outcome: `[num_rows]` int8, after it.
      distance_sq: squared distance of a collision, m^2.
      out: `[num_rows]` bool; other rows that are running become False, the rest stays.
    """
    per_world = running.shape[0] // state.pos_x.shape[0]
    for row in range(running.shape[0]):
        if not running[row]:
            continue
        out[row] = False
        if outcome[row] != _COLLISION:
            continue
        world, robot = world_of(state, row), state.learner[row]
        pos_x, pos_y = state.pos_x[world], state.pos_y[world]
        for other_row in range(world * per_world, (world + 1) * per_world):
            other = state.learner[other_row]
            dx, dy = pos_x[other] - pos_x[robot], pos_y[other] - pos_y[robot]
            if other_row != row and running[other_row] and dx * dx + dy * dy < distance_sq:
                out[row] = True
