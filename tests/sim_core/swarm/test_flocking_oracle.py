"""FL-ORCA's preferred velocities against an independent implementation of its rules.

The oracle uses angles in degrees and sets of robots instead of dot products, flags and passes. Scenes with a robot at a
threshold of some rule are left out.
"""

import numpy as np
import pytest

from sim_core.config import WorldConfig
from sim_core.swarm.flock_rules import FOLLOWER, SINGLE_GROUP, TURN_RIGHT, VISION_FREE

ROBOTS, GROUPS = 6, 3
MARGIN = 2e-4
"""A comparison of numbers that differ by no more than this is too close to call."""


def unit(vector):
    """The vector, scaled to length 1 if it is longer."""
    return np.asarray(vector) / max(1.0, np.linalg.norm(vector))


class Oracle:
    """The rules for one scene in float64; `clear` becomes false when a comparison is too close to call."""

    def __init__(self, config, pos, vel, goals):
        self.config, self.pos, self.vel = config, pos.astype(np.float64), vel.astype(np.float64)
        self.group = np.arange(len(pos)) // config.robots
        self.to_goal = np.asarray(goals, np.float64)[self.group] - self.pos
        self.clear = True
        robots = range(len(pos))
        self.neighbours = [self.find_neighbours(i) for i in robots]
        self.flockmates = [[j for j in self.neighbours[i] if self.group[j] == self.group[i]] for i in robots]
        self.others = [[j for j in self.neighbours[i] if self.group[j] != self.group[i]] for i in robots]
        blocked = self.blocked_published if config.flocking == "published" else self.blocked_uniform
        self.sees = {i for i in robots if self.sees_other_group(i)}
        self.free = {i for i in robots if not blocked(i)}
        self.text = config.state_machine == "text"
        self.first_two = {i for i in robots if i not in self.sees or i in self.free} if self.text else self.free
        self.level_1 = {i for i in set(robots) - self.first_two if self.first_two & set(self.flockmates[i])}
        self.level_2 = {i for i in set(robots) - self.free - self.level_1 if self.level_1 & set(self.flockmates[i])}
        self.followers = self.level_1 if self.text else self.level_1 | self.level_2

    def less(self, value, limit):
        """value < limit; `clear` becomes false if that is too close to call."""
        self.clear &= abs(value - limit) > MARGIN
        return value < limit

    def distance(self, i, j):
        return np.hypot(*(self.pos[j] - self.pos[i]))

    def angle(self, i, j):
        """The angle between the directions to j and to the goal, degrees."""
        a, b = (np.degrees(np.arctan2(v[1], v[0])) for v in (self.pos[j] - self.pos[i], self.to_goal[i]))
        return abs((a - b + 180) % 360 - 180)

    def find_neighbours(self, i):
        others = sorted((self.distance(i, j), j) for j in range(len(self.pos)) if j != i)
        in_range = [(d, j) for d, j in others if self.less(d, self.config.neighbour_range_m)]
        k = self.config.max_neighbours
        self.clear &= len(in_range) <= k or in_range[k][0] - in_range[k - 1][0] > MARGIN
        return [j for _, j in in_range[:k]]

    def sees_other_group(self, i):
        c = self.config
        seen = [self.less(self.distance(i, j), c.sight_range_m) & self.less(self.angle(i, j), c.sight_angle_deg)
                for j in self.others[i]]  # fmt: skip
        return any(seen)

    def blocked_published(self, i):
        c = self.config
        blocks = [self.less(self.distance(i, j), c.view_range_m) & self.less(self.angle(i, j), c.view_angle_deg)
                for j in self.neighbours[i]]  # fmt: skip
        return any(blocks)

    def blocked_uniform(self, i):
        goal_m = np.hypot(*self.to_goal[i])
        blocks = []
        for j in self.others[i]:
            angle, dist = np.radians(self.angle(i, j)), self.distance(i, j)
            ahead = self.less(0, dist * np.cos(angle)) & self.less(dist * np.cos(angle), goal_m)
            blocks.append(ahead & self.less(dist * np.sin(angle), self.config.uniform_view_corridor_m))
        return any(blocks)

    def leader(self, i):
        wanted = self.first_two if i in self.level_1 else self.level_1
        candidates = sorted((np.hypot(*self.to_goal[j]), j) for j in self.flockmates[i] if j in wanted)
        self.clear &= len(candidates) < 2 or candidates[1][0] - candidates[0][0] > MARGIN
        return candidates[0][1]

    def state(self, i):
        return self.state_of_text(i) if self.text else self.state_as_published(i)

    def state_of_text(self, i):
        """The table of Figure 2.2, line by line."""
        if i not in self.sees:
            return SINGLE_GROUP
        if i in self.free:
            return VISION_FREE
        unled = all(j in self.sees and j not in self.free for j in self.flockmates[i])
        return TURN_RIGHT if unled else FOLLOWER

    def state_as_published(self, i):
        if i in self.free:
            return VISION_FREE if i in self.sees else SINGLE_GROUP
        if i in self.followers:
            return FOLLOWER
        warned = i in self.sees or any(j in self.sees and j not in self.followers for j in self.flockmates[i])
        return TURN_RIGHT if warned else SINGLE_GROUP

    def separation(self, i):
        c = self.config
        if c.flocking == "published":
            near = [j for j in self.others[i] if self.less(self.distance(i, j), c.separation_range_m)
                    & self.less(self.angle(i, j), c.separation_angle_deg)]  # fmt: skip
            return -unit(np.mean(self.pos[near] - self.pos[i], axis=0)) if near else np.zeros(2)
        total, reach = np.zeros(2), c.uniform_separation_range_m
        for j in self.neighbours[i]:
            away, dist = self.pos[i] - self.pos[j], self.distance(i, j)
            total += away / dist * max(0, 1 - dist / reach)
        return unit(total)

    def velocity(self, i):
        flockmates, state, sees = self.flockmates[i], self.state(i), i in self.sees
        v1 = unit(self.pos[flockmates].mean(axis=0) - self.pos[i]) if flockmates else np.zeros(2)
        v3 = unit(self.vel[flockmates].mean(axis=0)) if flockmates else np.zeros(2)
        v2, z = self.separation(i), np.array([self.to_goal[i][1], -self.to_goal[i][0]])
        to_leader = self.pos[self.leader(i)] - self.pos[i] if state == FOLLOWER else np.zeros(2)
        if self.config.flocking == "uniform":
            pref = self.to_goal[i] / max(np.hypot(*self.to_goal[i]), self.config.uniform_slow_radius_m)
            steer = {FOLLOWER: to_leader / max(np.hypot(*to_leader), 1e-9), TURN_RIGHT: np.array([pref[1], -pref[0]])}
            return unit(0.3 * v1 + 1.0 * v2 + 0.3 * v3 + steer.get(state, pref))
        pref = unit(self.to_goal[i])
        total = {
            (VISION_FREE, True): 15 * v1 + 0.5 * v2 + 5 * v3 + 0.35 * pref,
            (FOLLOWER, True): 15 * v1 + 0.5 * v2 + 50 * to_leader,
            (TURN_RIGHT, True): 50 * v1 + 0.5 * v2 + 1 * v3 + 15 * z,
            (FOLLOWER, False): pref + 10 * v1 + 50 * to_leader,
            (TURN_RIGHT, False): pref + 15 * v1 + 2 * v3 + 50 * z,
            (SINGLE_GROUP, False): pref + v1 + v3,
        }[state, sees]
        self.clear &= np.linalg.norm(total) > 1e-2  # the direction of a shorter sum depends on rounding
        return unit(total)


@pytest.mark.parametrize("machine", ["published", "text"])
@pytest.mark.parametrize("rules", ["published", "uniform"])
def test_random_scenes_match_the_rules(rules, machine, make_flock):
    config = WorldConfig(robots=ROBOTS, groups=GROUPS, separation_noise=0.0, flocking=rules, state_machine=machine)
    rng = np.random.default_rng(5)
    compared, states = 0, np.zeros(4, int)
    for _ in range(160):
        size_m = rng.choice([0.6, 1.2, 2.0, 3.0])
        pos = rng.uniform(-size_m, size_m, (ROBOTS * GROUPS, 2)).astype(np.float32)
        vel = rng.normal(0, 0.6, pos.shape).astype(np.float32)
        goals = rng.uniform(-1, 1, (GROUPS, 2)).astype(np.float32) * rng.choice([0.5, 4.0])
        oracle = Oracle(config, pos, vel, goals)
        expected = [(oracle.state(i), oracle.velocity(i)) for i in range(len(pos))]
        if not oracle.clear:
            continue
        flock = make_flock(config, pos, goals, vel)
        assert flock.states.tolist() == [state for state, _ in expected]
        np.testing.assert_allclose(flock.velocity, [velocity for _, velocity in expected], atol=2e-4)
        compared += 1
        states += np.bincount(flock.states, minlength=4)
    assert compared > 40
    assert states.min() > 15  # every state of Figure 2.2 occurs
