"""FL-ORCA's preferred velocities: cohesion, separation, alignment and the state machine, for eight robots at a time.

Algorithm 3 and Figure 2.2 of the dissertation, after F. R. Inacio, D. G. Macharet, L. Chaimowicz (FL-ORCA). ORCA turns
the preferred velocity into the robot's new velocity (`sim_core.orca`).

The state machine depends on flags of the neighbours. To be independent of the order of the robots, the flags are
computed in passes over the whole tile, and no pass changes a flag that it reads:

1. every robot: sees another group; has a free view of its goal;
2. level-1 followers: their own view is not free, and a flockmate's is;
3. level-2 followers: their own view is not free, no flockmate's is, and a flockmate is a level-1 follower.

Flockmates are a robot's neighbours of its own group.

In the text's state machine (`state_machine`), a robot that sees no other group is in the state Single Group whatever
blocks its view: the first pass counts that view as free, so that a level-1 follower follows a robot in one of the first
two states. The third pass is left out.
"""

from __future__ import annotations

from sim_core.jit import inlined
from sim_core.lanes import any_lane, gather, gather_4, load, maximum, scatter, select, splat, sqrt, store
from sim_core.swarm.flock_rules import (
    FOLLOWER,
    FOLLOWER_LEVEL_1,
    FOLLOWER_LEVEL_2,
    NO_FLOCK,
    PUBLISHED,
    SEES_OTHER_GROUP,
    SINGLE_GROUP,
    TURN_RIGHT,
    VIEW_FREE,
    VISION_FREE,
)

FOLLOWER_ANY_LEVEL = FOLLOWER_LEVEL_1 | FOLLOWER_LEVEL_2


@inlined
def clip_norm(x, y, f):
    """The vectors (x, y), scaled to length 1 where they are longer."""
    length_sq = x * x + y * y
    scale = f.one / sqrt(length_sq)
    short = length_sq <= f.one
    return select(short, x, x * scale), select(short, y, y * scale)


@inlined
def _blocks_view(dx, dy, dist_sq, dist_m, goal_x, goal_y, goal_m, same_group, f):
    """Mask of the lanes where a neighbour at (dx, dy) blocks the robot's view of its goal."""
    dot = dx * goal_x + dy * goal_y
    if f.rules == PUBLISHED:
        return (dist_sq < f.view_range_sq) & (dot > f.view_cos * dist_m * goal_m)
    in_front = ~same_group & (dot > f.zero) & (dot < goal_m * goal_m)
    return in_front & (abs(dx * goal_y - dy * goal_x) < f.uniform_view_corridor_m * goal_m)


@inlined
def sense_neighbours(row, start, tile, f):
    """The first pass: a row's flags SEES_OTHER_GROUP and VIEW_FREE, its flocking terms and its flockmates.

    Cohesion and alignment are clipped to length 1 (Algorithm 3). Separation is not finished: `finish_separation`
    applies its random gain and clips it.

    Args:
      row: the row of the tile.
      start: vector of `tile.neighbours` where the row's lists start.
      tile: Tile with pos_vel, to_goal, group, neighbours and neighbour_counts; flags, flockmates and flock_terms are
        written.
      f: FlockParams.

    Returns:
      Vector, how many neighbours the published separation term counts; 0 for the uniform one.
    """
    robot = load(tile.row_slots, row)
    x, y, _, _ = gather_4(tile.pos_vel, robot)
    goal_x, goal_y, goal_sq, _ = gather_4(tile.to_goal, robot)
    group = gather(tile.group, robot)
    goal_m = sqrt(goal_sq)
    zero = splat(f.zero)
    coh_x, coh_y, ali_x, ali_y, sep_x, sep_y = zero, zero, zero, zero, zero, zero
    num_flockmates, num_separated = zero, zero
    view_free = splat(True)
    sees = ~view_free
    flockmates_start = row * tile.flockmates.shape[1]
    for k in range(tile.neighbour_counts[row]):
        other = load(tile.neighbours, start + k)
        present = other >= 0
        other = select(present, other, robot)
        other_x, other_y, other_vx, other_vy = gather_4(tile.pos_vel, other)
        same_group = present & (gather(tile.group, other) == group)
        other_group = present & ~same_group
        dx, dy = other_x - x, other_y - y
        dist_sq = dx * dx + dy * dy
        dist_m = sqrt(dist_sq)
        dot = dx * goal_x + dy * goal_y
        sees = sees | (other_group & (dist_sq < f.sight_range_sq) & (dot > f.sight_cos * dist_m * goal_m))
        blocks = _blocks_view(dx, dy, dist_sq, dist_m, goal_x, goal_y, goal_m, same_group, f)
        view_free = view_free & ~(present & blocks)
        store(tile.flockmates, flockmates_start + k, select(same_group, other, robot))
        num_flockmates = num_flockmates + select(same_group, f.one, zero)
        coh_x, coh_y = coh_x + select(same_group, dx, zero), coh_y + select(same_group, dy, zero)
        ali_x, ali_y = ali_x + select(same_group, other_vx, zero), ali_y + select(same_group, other_vy, zero)
        if f.rules == PUBLISHED:
            near = other_group & (dist_sq < f.separation_range_sq)
            near = near & (dot > f.separation_cos * dist_m * goal_m)
            num_separated = num_separated + select(near, f.one, zero)
            sep_x, sep_y = sep_x - select(near, dx, zero), sep_y - select(near, dy, zero)
        else:
            near = present & (dist_m > f.zero) & (dist_m < f.uniform_separation_range_m)
            push = f.one / dist_m - f.one / f.uniform_separation_range_m
            sep_x, sep_y = sep_x - select(near, push * dx, zero), sep_y - select(near, push * dy, zero)
    if f.follows_text:
        view_free = view_free | ~sees
    scatter(tile.flags, robot, select(sees, SEES_OTHER_GROUP, splat(0)) | select(view_free, VIEW_FREE, splat(0)))
    some = num_flockmates > f.zero
    coh_x, coh_y = clip_norm(select(some, coh_x / num_flockmates, zero), select(some, coh_y / num_flockmates, zero), f)
    ali_x, ali_y = clip_norm(select(some, ali_x / num_flockmates, zero), select(some, ali_y / num_flockmates, zero), f)
    _store_terms(row, tile, coh_x, coh_y, sep_x, sep_y, ali_x, ali_y)
    return num_separated


@inlined
def _store_terms(row, tile, coh_x, coh_y, sep_x, sep_y, ali_x, ali_y):
    store(tile.flock_terms, 6 * row, coh_x)
    store(tile.flock_terms, 6 * row + 1, coh_y)
    store(tile.flock_terms, 6 * row + 2, sep_x)
    store(tile.flock_terms, 6 * row + 3, sep_y)
    store(tile.flock_terms, 6 * row + 4, ali_x)
    store(tile.flock_terms, 6 * row + 5, ali_y)


@inlined
def finish_separation(row, tile, num_separated, gain, f):
    """Divides a row's separation by `num_separated` (the mean), multiplies it by `gain`, and clips it to length 1."""
    sep_x, sep_y = load(tile.flock_terms, 6 * row + 2), load(tile.flock_terms, 6 * row + 3)
    some = num_separated > f.zero
    scale = gain / num_separated
    sep_x, sep_y = clip_norm(select(some, scale * sep_x, sep_x), select(some, scale * sep_y, sep_y), f)
    store(tile.flock_terms, 6 * row + 2, sep_x)
    store(tile.flock_terms, 6 * row + 3, sep_y)


@inlined
def clear_leaders(row, tile):
    """Sets the leaders of a row's robots to none."""
    scatter(tile.leaders, load(tile.row_slots, row), splat(-1))


@inlined
def mark_followers(row, leader_flag, follower_flag, tile):
    """The second or third pass: finds leaders among a row's flockmates, and marks the followers.

    Robots whose view is not free and that have no leader yet follow a flockmate with `leader_flag`; of several, the
    one nearest to the goal. The second pass makes level-1 followers of robots with a free view, the third one level-2
    followers of level-1 followers. Nobody follows a level-2 follower.

    Args:
      row: the row of the tile.
      leader_flag: VIEW_FREE or FOLLOWER_LEVEL_1.
      follower_flag: FOLLOWER_LEVEL_1 or FOLLOWER_LEVEL_2, which this pass sets and does not read.
      tile: Tile with to_goal, flockmates and neighbour_counts; leaders and flags are changed.
    """
    robot = load(tile.row_slots, row)
    flags, leader = gather(tile.flags, robot), gather(tile.leaders, robot)
    needs_leader = ((flags & VIEW_FREE) == 0) & (leader < 0)
    if not any_lane(needs_leader):
        return
    found = splat(-1)
    best_sq = gather(tile.to_goal, robot * 4 + 2)
    start = row * tile.flockmates.shape[1]
    for k in range(tile.neighbour_counts[row]):
        flockmate = load(tile.flockmates, start + k)
        goal_sq = gather(tile.to_goal, flockmate * 4 + 2)
        better = ((gather(tile.flags, flockmate) & leader_flag) != 0) & ((found < 0) | (goal_sq < best_sq))
        found, best_sq = select(better, flockmate, found), select(better, goal_sq, best_sq)
    follows = needs_leader & (found >= 0)
    scatter(tile.leaders, robot, select(follows, found, leader))
    scatter(tile.flags, robot, flags | select(follows, follower_flag, splat(0)))


@inlined
def machine_state(row, tile):
    """(states of Figure 2.2, mask of those that see another group) of a row's robots, from the flags of all passes.

    Without a free view and a leader, a robot turns right if it sees another group, or if a flockmate that is no
    follower sees one.
    """
    robot = load(tile.row_slots, row)
    flags = gather(tile.flags, robot)
    sees, view_free = (flags & SEES_OTHER_GROUP) != 0, (flags & VIEW_FREE) != 0
    follows = (flags & FOLLOWER_ANY_LEVEL) != 0
    turns_right = ~view_free & ~follows & sees
    undecided = ~view_free & ~follows & ~sees
    if any_lane(undecided):
        start = row * tile.flockmates.shape[1]
        for k in range(tile.neighbour_counts[row]):
            flockmate_flags = gather(tile.flags, load(tile.flockmates, start + k))
            warned = (flockmate_flags & (SEES_OTHER_GROUP | FOLLOWER_ANY_LEVEL)) == SEES_OTHER_GROUP
            turns_right = turns_right | (undecided & warned)
    state = select(turns_right, TURN_RIGHT, splat(SINGLE_GROUP))
    state = select(~view_free & follows, FOLLOWER, state)
    return select(view_free & sees, VISION_FREE, state), sees


@inlined
def weighted_sum(state, sees, terms, goal_x, goal_y, leader_x, leader_y, f):
    """The weighted sum of the terms in each robot's state, clipped to length 1.

    Args:
      state: int32 vector, states of Figure 2.2.
      sees: mask of the robots that see another group.
      terms: six vectors, x and y of cohesion, separation and alignment.
      goal_x, goal_y: vectors, the goal relative to the robot, metres.
      leader_x, leader_y: vectors, the leader relative to the robot, metres; 0 where there is none.
      f: FlockParams.

    Returns:
      (x, y), vectors of length 1 at most.
    """
    weights_row = (state * 2 + select(sees, 1, splat(0))) * 2  # of the weights as rows of four
    cohesion, separation, alignment, preferred = gather_4(f.weights, weights_row)
    follow, right, _, _ = gather_4(f.weights, weights_row + 1)
    if f.rules == PUBLISHED:
        pref_x, pref_y = clip_norm(goal_x, goal_y, f)
        right_x, right_y = goal_y, -goal_x
    else:
        scale = f.one / maximum(sqrt(goal_x * goal_x + goal_y * goal_y), splat(f.uniform_slow_radius_m))
        pref_x, pref_y = goal_x * scale, goal_y * scale
        right_x, right_y = pref_y, -pref_x
        leader_m = sqrt(leader_x * leader_x + leader_y * leader_y)
        not_zero = leader_m > f.zero
        leader_x, leader_y = (
            select(not_zero, leader_x / leader_m, leader_x),
            select(not_zero, leader_y / leader_m, leader_y),
        )
    x = cohesion * terms[0] + separation * terms[2] + alignment * terms[4]
    y = cohesion * terms[1] + separation * terms[3] + alignment * terms[5]
    x = x + (preferred * pref_x + follow * leader_x + right * right_x)
    y = y + (preferred * pref_y + follow * leader_y + right * right_y)
    return clip_norm(x, y, f)


@inlined
def preferred_velocity(row, tile, f):
    """(x, y): preferred velocities of a row's robots after all passes, m/s (Algorithm 3 up to ORCA).

    Writes the robots' states to `tile.machine`.
    """
    robot = load(tile.row_slots, row)
    goal_x, goal_y, _, _ = gather_4(tile.to_goal, robot)
    if f.rules == NO_FLOCK:
        x, y = clip_norm(goal_x, goal_y, f)
        return x * f.max_speed_m_s, y * f.max_speed_m_s
    state, sees = machine_state(row, tile)
    scatter(tile.machine, robot, state)
    leader = gather(tile.leaders, robot)
    own_x, own_y, _, _ = gather_4(tile.pos_vel, robot)
    leader_x, leader_y, _, _ = gather_4(tile.pos_vel, select(leader >= 0, leader, robot))
    terms = (
        load(tile.flock_terms, 6 * row),
        load(tile.flock_terms, 6 * row + 1),
        load(tile.flock_terms, 6 * row + 2),
        load(tile.flock_terms, 6 * row + 3),
        load(tile.flock_terms, 6 * row + 4),
        load(tile.flock_terms, 6 * row + 5),
    )
    x, y = weighted_sum(state, sees, terms, goal_x, goal_y, leader_x - own_x, leader_y - own_y, f)
    return x * f.max_speed_m_s, y * f.max_speed_m_s
