"""FL-ORCA's preferred velocity: cohesion, separation, alignment and the four-state machine, eight robots at a time.

Algorithm 3 and Figure 2.2 of the dissertation, after F. R. Inacio, D. G. Macharet, L. Chaimowicz
(FL-ORCA). ORCA turns the result into the robot's new velocity (`sim_core.orca`).

The machine looks at neighbours' flags. Worlds are order-free: flags are found in passes over the old
state (sees another group and has a free view; follows a free robot; follows such a follower), never
robot by robot.
"""

from __future__ import annotations

from sim_core.jit import inlined
from sim_core.lanes import any_lane, gather, gather_4, load, maximum, root, scatter, select, splat, store
from sim_core.swarm.flock_rules import (
    FOLLOWER,
    FOLLOWS_FOLLOWER,
    FOLLOWS_FREE,
    FREE,
    NO_FLOCK,
    PUBLISHED,
    SEES,
    SINGLE_GROUP,
    TURN_RIGHT,
    VISION_FREE,
)

FOLLOWS = FOLLOWS_FREE | FOLLOWS_FOLLOWER


@inlined
def clipped(x, y, f):
    """Vectors (x, y), shortened to length 1 where longer."""
    length_sq = x * x + y * y
    scale = f.one / root(length_sq)
    short = length_sq <= f.one
    return select(short, x, x * scale), select(short, y, y * scale)


@inlined
def _blocks_view(dx, dy, dist_sq, dist_m, goal_x, goal_y, goal_m, same_group, f):
    """Where a neighbour at (dx, dy) stands between the robot and its goal."""
    ahead = dx * goal_x + dy * goal_y
    if f.rules == PUBLISHED:
        return (dist_sq < f.view_range_sq) & (ahead > f.view_cos * dist_m * goal_m)
    in_front = ~same_group & (ahead > f.zero) & (ahead < goal_m * goal_m)
    return in_front & (abs(dx * goal_y - dy * goal_x) < f.uniform_view_corridor_m * goal_m)


@inlined
def look(row, at, tile, f):
    """First pass: a row's flags SEES and FREE, its flock terms, and its neighbours of the own group.

    Args:
      row: the row of the tile.
      tile: Tile with body, aim, group, neighbours, counts; writes flags, mates and terms. Cohesion,
        separation and alignment are no longer than 1 (Algorithm 3), the separation without its random gain.
      f: FlockParams.

    Returns:
      Mask of the robots that the published separation acts on.
    """
    robot = load(tile.order, row)
    x, y, _, _ = gather_4(tile.body, robot)
    goal_x, goal_y, goal_sq, _ = gather_4(tile.aim, robot)
    group = gather(tile.group, robot)
    goal_m = root(goal_sq)
    zero = splat(f.zero)
    coh_x, coh_y, ali_x, ali_y, sep_x, sep_y = zero, zero, zero, zero, zero, zero
    own, apart = zero, zero
    free = splat(True)
    sees = ~free
    mates = row * tile.mates.shape[1]
    for k in range(tile.counts[row]):
        other = load(tile.neighbours, at + k)
        present = other >= 0
        other = select(present, other, robot)
        other_x, other_y, other_vx, other_vy = gather_4(tile.body, other)
        same_group = present & (gather(tile.group, other) == group)
        other_group = present & ~same_group
        dx, dy = other_x - x, other_y - y
        dist_sq = dx * dx + dy * dy
        dist_m = root(dist_sq)
        ahead = dx * goal_x + dy * goal_y
        sees = sees | (other_group & (dist_sq < f.sight_range_sq) & (ahead > f.sight_cos * dist_m * goal_m))
        free = free & ~(present & _blocks_view(dx, dy, dist_sq, dist_m, goal_x, goal_y, goal_m, same_group, f))
        store(tile.mates, mates + k, select(same_group, other, robot))
        own = own + select(same_group, f.one, zero)
        coh_x, coh_y = coh_x + select(same_group, dx, zero), coh_y + select(same_group, dy, zero)
        ali_x, ali_y = ali_x + select(same_group, other_vx, zero), ali_y + select(same_group, other_vy, zero)
        if f.rules == PUBLISHED:
            near = other_group & (dist_sq < f.separation_range_sq)
            near = near & (ahead > f.separation_cos * dist_m * goal_m)
            apart = apart + select(near, f.one, zero)
            sep_x, sep_y = sep_x - select(near, dx, zero), sep_y - select(near, dy, zero)
        else:
            near = present & (dist_m > f.zero) & (dist_m < f.uniform_separation_range_m)
            push = f.one / dist_m - f.one / f.uniform_separation_range_m
            sep_x, sep_y = sep_x - select(near, push * dx, zero), sep_y - select(near, push * dy, zero)
    scatter(tile.flags, robot, select(sees, SEES, splat(0)) | select(free, FREE, splat(0)))
    some = own > f.zero
    coh_x, coh_y = clipped(select(some, coh_x / own, zero), select(some, coh_y / own, zero), f)
    ali_x, ali_y = clipped(select(some, ali_x / own, zero), select(some, ali_y / own, zero), f)
    _store_terms(row, tile, coh_x, coh_y, sep_x, sep_y, ali_x, ali_y)
    return apart


@inlined
def _store_terms(row, tile, coh_x, coh_y, sep_x, sep_y, ali_x, ali_y):
    store(tile.terms, 6 * row, coh_x)
    store(tile.terms, 6 * row + 1, coh_y)
    store(tile.terms, 6 * row + 2, sep_x)
    store(tile.terms, 6 * row + 3, sep_y)
    store(tile.terms, 6 * row + 4, ali_x)
    store(tile.terms, 6 * row + 5, ali_y)


@inlined
def finish_separation(row, tile, apart, gain, f):
    """Divides the separation by the robots that it is from, multiplies it by `gain`, and clips it."""
    sep_x, sep_y = load(tile.terms, 6 * row + 2), load(tile.terms, 6 * row + 3)
    some = apart > f.zero
    scale = gain / apart
    sep_x, sep_y = clipped(select(some, scale * sep_x, sep_x), select(some, scale * sep_y, sep_y), f)
    store(tile.terms, 6 * row + 2, sep_x)
    store(tile.terms, 6 * row + 3, sep_y)


@inlined
def clear_leaders(row, tile):
    """Nobody in the row follows anybody."""
    scatter(tile.leaders, load(tile.order, row), splat(-1))


@inlined
def mark_followers(row, wanted, mark, tile):
    """Second and third pass: finds a row's leaders among the mates with flag `wanted` and marks the followers.

    Level 1 (`FOLLOWS_FREE`) follows a robot with a free view; level 2 (`FOLLOWS_FOLLOWER`), if there is none,
    a level-1 follower. Nobody follows level 2. Among several, the leader is the one nearest to the goal. A
    pass changes no flag that it reads.
    """
    robot = load(tile.order, row)
    flags, leader = gather(tile.flags, robot), gather(tile.leaders, robot)
    seeks = ((flags & FREE) == 0) & (leader < 0)
    if not any_lane(seeks):
        return
    found = splat(-1)
    best_sq = gather(tile.aim, robot * 4 + 2)
    at = row * tile.mates.shape[1]
    for k in range(tile.counts[row]):
        mate = load(tile.mates, at + k)
        goal_sq = gather(tile.aim, mate * 4 + 2)
        better = ((gather(tile.flags, mate) & wanted) != 0) & ((found < 0) | (goal_sq < best_sq))
        found, best_sq = select(better, mate, found), select(better, goal_sq, best_sq)
    follows = seeks & (found >= 0)
    scatter(tile.leaders, robot, select(follows, found, leader))
    scatter(tile.flags, robot, flags | select(follows, mark, splat(0)))


@inlined
def machine_state(row, tile):
    """States of Figure 2.2 of a row's robots from the flags of all passes: the first row that applies."""
    robot = load(tile.order, row)
    flags = gather(tile.flags, robot)
    sees, free, follows = (flags & SEES) != 0, (flags & FREE) != 0, (flags & FOLLOWS) != 0
    turns = ~free & ~follows & sees
    unsure = ~free & ~follows & ~sees
    if any_lane(unsure):
        at = row * tile.mates.shape[1]
        for k in range(tile.counts[row]):
            turns = turns | (unsure & ((gather(tile.flags, load(tile.mates, at + k)) & (SEES | FOLLOWS)) == SEES))
    state = select(turns, TURN_RIGHT, splat(SINGLE_GROUP))
    state = select(~free & follows, FOLLOWER, state)
    return select(free & sees, VISION_FREE, state), sees


@inlined
def weighted_sum(state, sees, terms, goal_x, goal_y, leader_x, leader_y, f):
    """The states' weighted sums of terms, set to length 1 where longer; `leader`, `goal` are relative."""
    which = (state * 2 + select(sees, 1, splat(0))) * 2
    cohesion, separation, alignment, preferred = gather_4(f.weights, which)
    follow, right, _, _ = gather_4(f.weights, which + 1)
    if f.rules == PUBLISHED:
        pref_x, pref_y = clipped(goal_x, goal_y, f)
        right_x, right_y = goal_y, -goal_x
    else:
        scale = f.one / maximum(root(goal_x * goal_x + goal_y * goal_y), splat(f.uniform_slow_radius_m))
        pref_x, pref_y = goal_x * scale, goal_y * scale
        right_x, right_y = pref_y, -pref_x
        leader_m = root(leader_x * leader_x + leader_y * leader_y)
        somewhere = leader_m > f.zero
        leader_x, leader_y = (
            select(somewhere, leader_x / leader_m, leader_x),
            select(somewhere, leader_y / leader_m, leader_y),
        )
    x = cohesion * terms[0] + separation * terms[2] + alignment * terms[4]
    y = cohesion * terms[1] + separation * terms[3] + alignment * terms[5]
    x = x + (preferred * pref_x + follow * leader_x + right * right_x)
    y = y + (preferred * pref_y + follow * leader_y + right * right_y)
    return clipped(x, y, f)


@inlined
def preferred_velocity(row, tile, f):
    """Preferred velocities (m/s, vectors) of a row's robots after all passes (Algorithm 3 up to ORCA)."""
    robot = load(tile.order, row)
    goal_x, goal_y, _, _ = gather_4(tile.aim, robot)
    if f.rules == NO_FLOCK:
        x, y = clipped(goal_x, goal_y, f)
        return x * f.max_speed_m_s, y * f.max_speed_m_s
    state, sees = machine_state(row, tile)
    scatter(tile.machine, robot, state)
    leader = gather(tile.leaders, robot)
    own_x, own_y, _, _ = gather_4(tile.body, robot)
    leader_x, leader_y, _, _ = gather_4(tile.body, select(leader >= 0, leader, robot))
    terms = (
        load(tile.terms, 6 * row),
        load(tile.terms, 6 * row + 1),
        load(tile.terms, 6 * row + 2),
        load(tile.terms, 6 * row + 3),
        load(tile.terms, 6 * row + 4),
        load(tile.terms, 6 * row + 5),
    )
    x, y = weighted_sum(state, sees, terms, goal_x, goal_y, leader_x - own_x, leader_y - own_y, f)
    return x * f.max_speed_m_s, y * f.max_speed_m_s
