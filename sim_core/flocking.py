"""FL-ORCA's preferred velocity: cohesion, separation, alignment and the four-state machine.

Algorithm 3 and Figure 2.2 of the dissertation, after F. R. Inacio, D. G. Macharet, L. Chaimowicz
(FL-ORCA). ORCA turns the result into the robot's new velocity (`sim_core.orca`).

The machine looks at neighbours' flags. Worlds are order-free: flags are found in passes over the old
state (sees another group and has a free view; follows a free robot; follows such a follower), never
robot by robot.
"""

from __future__ import annotations

import numpy as np

from sim_core.flock_rules import (
    ALIGNMENT,
    COHESION,
    FOLLOWER,
    FOLLOWS_FOLLOWER,
    FOLLOWS_FREE,
    FREE,
    LEADER,
    PREFERRED,
    RIGHT,
    SEES,
    SEPARATION,
    SINGLE_GROUP,
    TURN_RIGHT,
    VISION_FREE,
)
from sim_core.jit import kernel
from sim_core.rng import uniform


@kernel
def clipped(x, y, f):
    """(x, y), shortened to length 1 if longer."""
    length_sq = x * x + y * y
    if length_sq <= f.one:
        return x, y
    scale = f.one / np.sqrt(length_sq)
    return x * scale, y * scale


@kernel
def _blocks_view(dx, dy, dist_sq, to_goal_x, to_goal_y, goal_m, own_group, f):
    """Whether a neighbour at (dx, dy) stands between the robot and its goal."""
    ahead = dx * to_goal_x + dy * to_goal_y
    if f.published:
        return dist_sq < f.view_range_sq and ahead > f.view_cos * np.sqrt(dist_sq) * goal_m
    if own_group or ahead <= f.zero or ahead >= goal_m * goal_m:
        return False
    return abs(dx * to_goal_y - dy * to_goal_x) < f.uniform_view_corridor_m * goal_m


@kernel
def sight_flags(robot, pos_x, pos_y, goal_x, goal_y, neighbours, count, f):
    """First pass: whether a robot sees another group and whether its view of the goal is free.

    Args:
      robot: index of the robot.
      pos_x, pos_y: `[num_robots]`, one world's old positions, metres.
      goal_x, goal_y: `[groups]`, metres.
      neighbours: `[max_neighbours]` int32, nearest first.
      count: number of neighbours.
      f: FlockParams.

    Returns:
      Flags SEES | FREE.
    """
    group = robot // f.robots
    to_goal_x, to_goal_y = goal_x[group] - pos_x[robot], goal_y[group] - pos_y[robot]
    goal_m = np.sqrt(to_goal_x * to_goal_x + to_goal_y * to_goal_y)
    sees, free = False, True
    for k in range(count):
        other = neighbours[k]
        dx, dy = pos_x[other] - pos_x[robot], pos_y[other] - pos_y[robot]
        dist_sq = dx * dx + dy * dy
        own_group = other // f.robots == group
        if not own_group and dist_sq < f.sight_range_sq:
            sees |= dx * to_goal_x + dy * to_goal_y > f.sight_cos * np.sqrt(dist_sq) * goal_m
        free &= not _blocks_view(dx, dy, dist_sq, to_goal_x, to_goal_y, goal_m, own_group, f)
    return (SEES if sees else 0) | (FREE if free else 0)


@kernel
def find_leader(robot, pos_x, pos_y, goal_x, goal_y, neighbours, count, flags, wanted, f):
    """The same-group neighbour with flag `wanted` that is nearest to the goal, or -1."""
    group = robot // f.robots
    leader = -1
    best_sq = f.zero
    for k in range(count):
        other = neighbours[k]
        if other // f.robots != group or not flags[other] & wanted:
            continue
        dx, dy = goal_x[group] - pos_x[other], goal_y[group] - pos_y[other]
        dist_sq = dx * dx + dy * dy
        if leader < 0 or dist_sq < best_sq:
            leader, best_sq = other, dist_sq
    return leader


@kernel
def machine_state(robot, neighbours, count, flags, f):
    """State of Figure 2.2 from the flags of all passes: the first row that applies."""
    own = flags[robot]
    if own & FREE:
        return VISION_FREE if own & SEES else SINGLE_GROUP
    if own & (FOLLOWS_FREE | FOLLOWS_FOLLOWER):
        return FOLLOWER
    if own & SEES:
        return TURN_RIGHT
    for k in range(count):
        other = neighbours[k]
        same_group = other // f.robots == robot // f.robots
        if same_group and flags[other] & SEES and not flags[other] & (FOLLOWS_FREE | FOLLOWS_FOLLOWER):
            return TURN_RIGHT
    return SINGLE_GROUP


@kernel
def flock_terms(robot, pos_x, pos_y, vel_x, vel_y, to_goal_x, to_goal_y, neighbours, count, noise, f):
    """Cohesion, separation and alignment of one robot, each no longer than 1 (Algorithm 3).

    Args:
      robot: index of the robot.
      pos_x, pos_y, vel_x, vel_y: `[num_robots]`, one world's old state.
      to_goal_x, to_goal_y: from the robot to its goal, metres.
      neighbours, count: the robot's neighbours, nearest first.
      noise: gain - 1 of the published separation term.
      f: FlockParams.

    Returns:
      (cohesion x, y, separation x, y, alignment x, y).
    """
    group = robot // f.robots
    coh_x, coh_y, ali_x, ali_y, sep_x, sep_y = f.zero, f.zero, f.zero, f.zero, f.zero, f.zero
    own, apart = f.zero, f.zero
    goal_m = np.sqrt(to_goal_x * to_goal_x + to_goal_y * to_goal_y)
    for k in range(count):
        other = neighbours[k]
        dx, dy = pos_x[other] - pos_x[robot], pos_y[other] - pos_y[robot]
        dist_sq = dx * dx + dy * dy
        same_group = other // f.robots == group
        if same_group:
            own += f.one
            coh_x, coh_y = coh_x + dx, coh_y + dy
            ali_x, ali_y = ali_x + vel_x[other], ali_y + vel_y[other]
        if f.published:
            near = not same_group and dist_sq < f.separation_range_sq
            if near and dx * to_goal_x + dy * to_goal_y > f.separation_cos * np.sqrt(dist_sq) * goal_m:
                apart += f.one
                sep_x, sep_y = sep_x - dx, sep_y - dy
        else:
            dist_m = np.sqrt(dist_sq)
            if f.zero < dist_m < f.uniform_separation_range_m:
                push = f.one / dist_m - f.one / f.uniform_separation_range_m
                sep_x, sep_y = sep_x - push * dx, sep_y - push * dy
    if own > f.zero:
        coh_x, coh_y, ali_x, ali_y = coh_x / own, coh_y / own, ali_x / own, ali_y / own
    if apart > f.zero:
        gain = (f.one + noise) / apart
        sep_x, sep_y = gain * sep_x, gain * sep_y
    coh_x, coh_y = clipped(coh_x, coh_y, f)
    sep_x, sep_y = clipped(sep_x, sep_y, f)
    ali_x, ali_y = clipped(ali_x, ali_y, f)
    return coh_x, coh_y, sep_x, sep_y, ali_x, ali_y


@kernel
def weighted_sum(state, sees, terms, to_goal_x, to_goal_y, to_leader_x, to_leader_y, f):
    """The state's weighted sum of terms, set to length 1 if longer."""
    row = f.weights[state, 1 if sees else 0]
    if f.published:
        pref_x, pref_y = clipped(to_goal_x, to_goal_y, f)
        right_x, right_y = to_goal_y, -to_goal_x
    else:
        goal_m = np.sqrt(to_goal_x * to_goal_x + to_goal_y * to_goal_y)
        scale = f.one / max(goal_m, f.uniform_slow_radius_m)
        pref_x, pref_y = to_goal_x * scale, to_goal_y * scale
        right_x, right_y = pref_y, -pref_x
        leader_m = np.sqrt(to_leader_x * to_leader_x + to_leader_y * to_leader_y)
        if leader_m > f.zero:
            to_leader_x, to_leader_y = to_leader_x / leader_m, to_leader_y / leader_m
    x = row[COHESION] * terms[0] + row[SEPARATION] * terms[2] + row[ALIGNMENT] * terms[4]
    y = row[COHESION] * terms[1] + row[SEPARATION] * terms[3] + row[ALIGNMENT] * terms[5]
    x += row[PREFERRED] * pref_x + row[LEADER] * to_leader_x + row[RIGHT] * right_x
    y += row[PREFERRED] * pref_y + row[LEADER] * to_leader_y + row[RIGHT] * right_y
    return clipped(x, y, f)


@kernel
def mark_followers(pos_x, pos_y, goal_x, goal_y, neighbours, counts, flags, leaders, f):
    """Second and third pass: finds each blocked robot's leader and marks it as a follower.

    Level 1 follows a robot with a free view; level 2, if there is none, a level-1 follower. Nobody
    follows level 2. Among several, the leader is the one nearest to the goal.

    Args:
      pos_x, pos_y: `[num_robots]`, one world's old positions.
      goal_x, goal_y: `[groups]`.
      neighbours: `[num_robots, max_neighbours]` int32.
      counts: `[num_robots]` int32.
      flags: `[num_robots]` uint8 with SEES | FREE; follower bits are added.
      leaders: `[num_robots]` int32, written; -1 where there is none.
      f: FlockParams.
    """
    for level in range(2):
        wanted = FREE if level == 0 else FOLLOWS_FREE
        mark = FOLLOWS_FREE if level == 0 else FOLLOWS_FOLLOWER
        for i in range(pos_x.shape[0]):
            if level == 0:
                leaders[i] = -1
            if flags[i] & FREE or leaders[i] >= 0:
                continue
            leaders[i] = find_leader(i, pos_x, pos_y, goal_x, goal_y, neighbours[i], counts[i], flags, wanted, f)
        for i in range(pos_x.shape[0]):
            if leaders[i] >= 0 and not flags[i] & (FOLLOWS_FREE | FOLLOWS_FOLLOWER):
                flags[i] |= np.uint8(mark)


@kernel
def preferred_velocities(
    world,
    pos_x,
    pos_y,
    vel_x,
    vel_y,
    goal_x,
    goal_y,
    neighbours,
    counts,
    flags,
    leaders,
    states,
    pref_x,
    pref_y,
    rng,
    f,
):
    """Preferred velocities of all robots of one world (Algorithm 3 up to ORCA).

    Args:
      world: index of the world in `rng`.
      pos_x, pos_y, vel_x, vel_y: `[num_robots]`, the world's old state.
      goal_x, goal_y: `[groups]`, metres.
      neighbours, counts: `[num_robots, max_neighbours]` and `[num_robots]` int32.
      flags, leaders: scratch `[num_robots]` uint8 and int32.
      states: `[num_robots]` int8, written (see STATE_NAMES).
      pref_x, pref_y: `[num_robots]`, written, m/s.
      rng: `[num_worlds]` uint64; one draw a robot if the separation is noisy.
      f: FlockParams.
    """
    for i in range(pos_x.shape[0]):
        flags[i] = sight_flags(i, pos_x, pos_y, goal_x, goal_y, neighbours[i], counts[i], f)
    mark_followers(pos_x, pos_y, goal_x, goal_y, neighbours, counts, flags, leaders, f)
    for i in range(pos_x.shape[0]):
        group = i // f.robots
        to_goal_x, to_goal_y = goal_x[group] - pos_x[i], goal_y[group] - pos_y[i]
        state = machine_state(i, neighbours[i], counts[i], flags, f)
        states[i] = state
        noise = f.zero
        if f.published and f.separation_noise > f.zero:
            pref_x[i] = uniform(rng, world)  # through the array, into the worlds' dtype
            noise = f.separation_noise * pref_x[i]
        terms = flock_terms(i, pos_x, pos_y, vel_x, vel_y, to_goal_x, to_goal_y, neighbours[i], counts[i], noise, f)
        leader = leaders[i] if leaders[i] >= 0 else i
        x, y = weighted_sum(
            state, flags[i] & SEES, terms, to_goal_x, to_goal_y, pos_x[leader] - pos_x[i], pos_y[leader] - pos_y[i], f
        )
        pref_x[i], pref_y[i] = x * f.max_speed_m_s, y * f.max_speed_m_s
