"""Rows: the learning robots of a batch of worlds, world after world, each with an episode of its own.

Where several robots of a world learn, the built-in methods read the world through `sim_core.state.world_of`. All that
knows one learning robot a world (senses, shield, a method of a user's own) gets `RowView.state`, in which every row is
a world of its own: a copy of the row's world.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_core.config import WorldConfig
from sim_core.jit import kernel
from sim_core.outcomes import Outcome
from sim_core.rng import bits_at, uniform_at
from sim_core.state import CONSTANT, PER_ROW, WorldState, world_of

LEARNER_STREAM = 2**33
"""The draw of a world's stream, far behind its others, that is the state of the stream that learning robots have."""
ROW_STREAM = 2**34
"""The draw, and those after it, that are the states of the rows' own streams."""
_RUNNING = int(Outcome.RUNNING)


@kernel
def draw_learners(state, mask, scene_learner, counts):
    """Draws the learning robots of worlds where `mask` is set, in ascending order: `counts` `[groups]` of each group.

    All robots of a group alike (Knuth 1969, Algorithm S), but the scene's own learning robot `scene_learner`
    `[num_worlds]` is always among them. Every robot has one draw of its own, of a stream beside the world's: the same
    world starts alike whatever learns in it, and those that learn are among those that learn where more do.
    """
    row = 0
    for world in range(mask.shape[0]):
        stream = bits_at(state.rng[world], LEARNER_STREAM)
        for group in range(counts.shape[0]):
            begin, end = state.group_begin[group], state.group_begin[group + 1]
            wanted, left = counts[group], end - begin
            if begin <= scene_learner[world] < end:
                wanted, left = wanted - 1, left - 1
            if not mask[world]:
                row += counts[group]
                continue
            for robot in range(begin, end):
                takes = robot == scene_learner[world]
                if not takes:
                    takes = uniform_at(stream, robot + 1) * left < wanted
                    wanted, left = wanted - takes, left - 1
                if takes:
                    state.learner[row] = robot
                    row += 1


@kernel
def begin_decision(outcome, running, is_running):
    """Sets which rows and worlds run: rows that have not ended, and worlds that have such rows.

    A world that has ended and is not restarted stays as it ended; that of a single learning robot goes on as if it had
    not.

    Args:
      outcome: `[num_rows]` int8.
      running: `[num_rows]` bool, written.
      is_running: `[num_worlds]` bool, written.
    """
    per_world = running.shape[0] // is_running.shape[0]
    for world in range(is_running.shape[0]):
        any_runs = False
        for row in range(world * per_world, (world + 1) * per_world):
            running[row] = outcome[row] == _RUNNING or per_world == 1
            any_runs |= running[row]
        is_running[world] = any_runs


@kernel
def end_step(state, running, is_running, ended_early, outcome, step_reward, reward, steps):
    """Adds the rewards of the rows that were running, and stops those that have ended.

    Args:
      state: WorldState.
      running, is_running: as in `begin_decision`; changed in place.
      ended_early: `[num_rows]` bool, written: which rows have ended in this step in worlds that go on.
      outcome, step_reward: `[num_rows]`, of this step.
      reward: `[num_rows]`, a sum.
      steps: `[num_rows]` int32, simulator steps of the episode, written.

    Returns:
      (whether any row still runs, whether any has ended early).
    """
    per_world = running.shape[0] // is_running.shape[0]
    any_runs, any_early = False, False
    for world in range(is_running.shape[0]):
        if not is_running[world]:
            for row in range(world * per_world, (world + 1) * per_world):
                ended_early[row] = False
            continue
        goes_on = False
        for row in range(world * per_world, (world + 1) * per_world):
            ended_early[row] = False
            if running[row]:
                reward[row] += step_reward[row]
                steps[row] = state.steps[world]
                running[row] = outcome[row] == _RUNNING
                ended_early[row] = not running[row]
                goes_on |= running[row]
        for row in range(world * per_world, (world + 1) * per_world):
            ended_early[row] &= goes_on
            any_early |= ended_early[row]
        is_running[world] = goes_on
        any_runs |= goes_on
    return any_runs, any_early


@kernel
def leave_worlds(state, running, is_running):
    """Takes robots whose episode has ended out of worlds that go on: to NaN, where nobody meets them."""
    for row in range(running.shape[0]):
        world, robot = world_of(state, row), state.learner[row]
        if is_running[world] and not running[row]:
            state.pos_x[world, robot] = state.pos_y[world, robot] = np.float32(np.nan)
            state.vel_x[world, robot] = state.vel_y[world, robot] = np.float32(0)


def counts_of(config: WorldConfig) -> NDArray[np.int64]:
    """Learning robots `[groups]` of each group."""
    return np.array(config.learner_counts, np.int64)


class RowView:
    """The worlds with a world of its own for every row.

    Args:
      state: the worlds.

    Attributes:
      state: `num_rows` worlds of one learning robot each: copies of the worlds' arrays, and the rows' own arrays, which
        are those of the worlds. Each row has a random stream of its own.
    """

    def __init__(self, state: WorldState) -> None:
        self._worlds = state
        self._per_world = len(state.learner) // len(state.pos_x)
        self._copied = [name for name in state._fields if name not in (*PER_ROW, *CONSTANT)]
        copies = {name: np.repeat(getattr(state, name), self._per_world, axis=0) for name in self._copied}
        self.state = state._replace(**copies)

    def refresh(self, mask: NDArray[np.bool_]) -> None:
        """Copies the worlds as they are now, where `mask` `[num_rows]` is set; other rows stay as they were."""
        of_worlds = mask.reshape(-1, self._per_world)
        for name in self._copied:
            array, copy = getattr(self._worlds, name), getattr(self.state, name)
            where = of_worlds.reshape(*of_worlds.shape, *(1 for _ in array.shape[1:]))
            np.copyto(copy.reshape(len(array), self._per_world, *array.shape[1:]), array[:, None], where=where)
        _spread(self.state.rng, mask, self._per_world)


@kernel
def _spread(rng, mask, per_world):
    for row in range(rng.shape[0]):
        if mask[row]:
            rng[row] = bits_at(rng[row], ROW_STREAM + row % per_world)
