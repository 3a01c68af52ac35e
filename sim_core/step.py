"""One step of the swarm in every world: all robots read the old state, then all move.

The learning robot takes the velocity it is given, or, without a pilot, FL-ORCA's like everybody else.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sim_core.config import WorldConfig
from sim_core.flock_rules import FlockParams, flock_params
from sim_core.flocking import preferred_velocities
from sim_core.jit import kernel
from sim_core.neighbours import find_neighbours
from sim_core.orca import ORCAParams, orca_params, orca_velocity
from sim_core.scenario import start_world


class SwarmParams(NamedTuple):
    """Constants of the swarm's step in the worlds' dtype."""

    orca: ORCAParams
    flock: FlockParams
    neighbour_range_sq: Any
    time_step_s: Any
    knows_learner: bool


def swarm_params(config: WorldConfig, dtype: Any) -> SwarmParams:
    """The swarm's constants of `config`."""
    real = np.dtype(dtype).type
    return SwarmParams(
        orca=orca_params(config.orca_radius_m, config.orca_horizon_s, config.time_step_s, config.max_speed_m_s, dtype),
        flock=flock_params(config, dtype),
        neighbour_range_sq=real(config.neighbour_range_m) ** 2,
        time_step_s=real(config.time_step_s),
        knows_learner=config.swarm_knows_learner,
    )


@kernel
def swarm_velocities(world, state, scratch, hidden, p):
    """FL-ORCA's new velocities of all robots of one world, into `scratch.new_vx`, `scratch.new_vy`."""
    pos_x, pos_y = state.pos_x[world], state.pos_y[world]
    vel_x, vel_y = state.vel_x[world], state.vel_y[world]
    for i in range(pos_x.shape[0]):
        scratch.counts[i] = find_neighbours(
            i, pos_x, pos_y, hidden, p.neighbour_range_sq, scratch.neighbours[i], scratch.distances_sq
        )
    preferred_velocities(
        world,
        pos_x,
        pos_y,
        vel_x,
        vel_y,
        state.goal_x[world],
        state.goal_y[world],
        scratch.neighbours,
        scratch.counts,
        scratch.flags,
        scratch.leaders,
        state.machine[world],
        scratch.pref_x,
        scratch.pref_y,
        state.rng,
        p.flock,
    )
    for i in range(pos_x.shape[0]):
        scratch.new_vx[i], scratch.new_vy[i] = orca_velocity(
            i,
            pos_x,
            pos_y,
            vel_x,
            vel_y,
            scratch.neighbours[i],
            scratch.counts[i],
            scratch.pref_x[i],
            scratch.pref_y[i],
            scratch.lines,
            scratch.projected,
            p.orca,
        )


@kernel
def advance(state, scratch, command_x, command_y, piloted, p):
    """Moves every world by one step.

    Args:
      state: WorldState, changed in place.
      scratch: Scratch.
      command_x, command_y: `[num_worlds]`, the learning robot's velocity, m/s.
      piloted: whether the learning robot obeys the command; else FL-ORCA drives it too.
      p: SwarmParams.
    """
    for world in range(state.pos_x.shape[0]):
        learner = state.learner[world]
        hidden = -1 if p.knows_learner else learner
        swarm_velocities(world, state, scratch, hidden, p)
        if piloted:
            scratch.new_vx[learner] = command_x[world]
            scratch.new_vy[learner] = command_y[world]
        for i in range(state.pos_x.shape[1]):
            state.vel_x[world, i] = scratch.new_vx[i]
            state.vel_y[world, i] = scratch.new_vy[i]
            state.pos_x[world, i] += scratch.new_vx[i] * p.time_step_s
            state.pos_y[world, i] += scratch.new_vy[i] * p.time_step_s
        state.steps[world] += 1


@kernel
def restart(state, mask, s):
    """Starts a new episode in every world where `mask` `[num_worlds]` bool is set; `s`: ScenarioParams."""
    for world in range(mask.shape[0]):
        if not mask[world]:
            continue
        start_world(
            world,
            state.pos_x,
            state.pos_y,
            state.vel_x,
            state.vel_y,
            state.goal_x,
            state.goal_y,
            state.learner,
            state.rng,
            s,
        )
        state.steps[world] = 0
        state.episode_return[world] = 0.0
        learner = state.learner[world]
        group = learner // s.robots
        dx = state.pos_x[world, learner] - state.goal_x[world, group]
        dy = state.pos_y[world, learner] - state.goal_y[world, group]
        state.goal_distance_m[world] = np.sqrt(dx * dx + dy * dy)
        for i in range(state.pos_x.shape[1]):
            state.machine[world, i] = 0
