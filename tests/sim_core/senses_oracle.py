"""The sensing stage written again: plain Python and numpy, one world and one robot at a time, by its documentation."""

import math
from typing import Any

import numpy as np

from sim_core.config import WorldConfig
from sim_core.worlds import WorldBatch

MASK = 2**64 - 1
GAMMA = 0x9E3779B97F4A7C15


def bits(stream: int, draw: int) -> int:
    """Draw `draw` of SplitMix64, as in the paper."""
    z = (stream + draw * GAMMA) & MASK
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & MASK
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & MASK
    return z ^ (z >> 31)


def uniform(stream: int, draw: int) -> float:
    return (bits(stream, draw) >> 11) / 2.0**53


def normal_pair(stream: int, draw: int) -> np.ndarray:
    """Two normal numbers of one draw (Box and Muller 1958); the radius is that of a float32."""
    word = bits(stream, draw)
    u = float((np.float32(word >> 32) + np.float32(0.5)) * np.float32(2.0**-32))
    turn = float(np.uint32(word & 0xFFFFFFFF).astype(np.int32)) / 2.0**32
    return math.sqrt(-2 * math.log(u)) * np.array([math.cos(2 * math.pi * turn), math.sin(2 * math.pi * turn)])


class Oracle:
    """Follows one world of a batch; `look` is to be called after a reset and after every simulator step."""

    def __init__(self, config: WorldConfig, worlds: WorldBatch, world: int) -> None:
        self.config, self.worlds, self.world = config, worlds, world
        state = worlds.state
        self.learner, self.group = int(state.learner[world]), state.group
        self.own = self.group[self.learner]
        self.n = config.num_robots
        self.stream = bits(int(state.rng[world]), 2**32)
        self.strength = [uniform(self.stream, i + 1) if config.conditions == "drawn" else 1.0 for i in range(11)]
        self.draw = 11
        self.dropped = self._dropped()
        self.in_burst = [
            uniform(self.stream, self.draw + self.n + 1 + i) < self.real("burst_loss", 2) for i in range(self.n)
        ]
        self.draw += 2 * self.n
        self.past: list[np.ndarray] = []
        self.tracked, self.age = np.zeros((self.n, 4)), [config.track_steps] * self.n
        self.commands: list[np.ndarray] = []

    def real(self, name: str, place: int) -> float:
        return float(getattr(self.config, name) * self.strength[place])

    def whole(self, name: str, place: int) -> int:
        most = getattr(self.config, name)
        return min(int(self.strength[place] * (most + 1)), most)

    def _dropped(self) -> set[int]:
        wanted, found = self.whole("dropped_mates", 4), set[int]()
        mates = [i for i in range(self.n) if self.group[i] == self.own and i != self.learner]
        for place, mate in enumerate(mates):  # selection sampling
            if uniform(self.stream, self.draw + mate + 1) * (len(mates) - place) < wanted - len(found):
                found.add(mate)
        return found

    def truth(self) -> np.ndarray:
        """`[num_robots, 4]`: x, y, vx, vy."""
        state = self.worlds.state
        return np.stack([a[self.world] for a in (state.pos_x, state.pos_y, state.vel_x, state.vel_y)], axis=1)

    def _sees(self, robot: np.ndarray, me: np.ndarray) -> bool:
        away = robot[:2].astype(float) - me[:2]
        if self.config.sensing_range_m and np.hypot(*away) > self.config.sensing_range_m / self.strength[5]:
            return False
        ahead = me[2:].astype(float)
        if not ahead.any():
            goal = self.worlds.state.goal_x[self.world, self.own], self.worlds.state.goal_y[self.world, self.own]
            ahead = np.array(goal, float) - me[:2]
        turn = math.degrees(math.atan2(ahead[0] * away[1] - ahead[1] * away[0], ahead @ away))
        angle = 360 - self.strength[6] * (360 - self.config.field_of_view_deg)
        return abs(turn) <= angle / 2

    def _loses(self, i: int) -> bool:
        at, share = self.draw + 5 * i, self.real("burst_loss", 2)
        if share:
            leave = 1 / self.config.burst_steps
            chance = uniform(self.stream, at + 2)
            self.in_burst[i] = chance >= leave if self.in_burst[i] else chance < leave * share / (1 - share)
        alone = uniform(self.stream, at + 1) < self.real("position_loss", 1)
        return alone or i in self.dropped or bool(share and self.in_burst[i])

    def _noise(self, i: int) -> np.ndarray:
        return self.real("position_noise_m", 0) * normal_pair(self.stream, self.draw + 5 * i + 3)

    def _mix_up(self, seen: np.ndarray) -> None:
        for i in range(self.n):
            at = self.draw + 5 * i
            if i != self.learner and uniform(self.stream, at + 4) < self.real("group_mix_up", 7):
                others = [j for j in range(self.n) if self.group[j] != self.group[i] and j != self.learner]
                if others:
                    j = others[int(uniform(self.stream, at + 5) * len(others))]
                    seen[[i, j]] = seen[[j, i]]

    def _track(self, seen: np.ndarray) -> None:
        """In place of a robot that is not sensed any more, where its last velocity has taken it."""
        for i in range(self.n):
            if not np.isnan(seen[i, 0]):
                self.tracked[i], self.age[i] = seen[i], 0
            elif self.age[i] < self.config.track_steps:
                self.tracked[i, :2] += self.tracked[i, 2:] * self.config.time_step_s
                seen[i] = self.tracked[i]
                self.age[i] += 1

    def look(self) -> np.ndarray:
        """What is sensed now, `[num_robots, 4]`."""
        truth = self.truth()
        self.past.append(truth)
        seen = self.past[max(0, len(self.past) - 1 - self.whole("position_delay_steps", 3))].copy()
        for i in range(self.n):
            visible = self._sees(seen[i], truth[self.learner])
            if self._loses(i) or not visible:
                seen[i] = np.nan
            else:
                seen[i, :2] += self._noise(i)
        self._mix_up(seen)
        self._track(seen)
        seen[self.learner] = truth[self.learner]
        self.draw += 5 * self.n + 2
        return seen

    def drive(self, command: Any) -> np.ndarray:
        """What is driven for a command `[2]`; to be called once a step, after `look`, whose draws it follows."""
        self.commands.append(np.asarray(command, float))
        late = len(self.commands) - 1 - self.whole("command_delay_steps", 8)
        x, y = self.commands[late] if late >= 0 else (0.0, 0.0)
        speed = 1 + self.real("speed_error", 9) * (2 * uniform(self.stream, self.draw - 1) - 1)
        turn = math.radians(self.real("heading_error_deg", 10)) * (2 * uniform(self.stream, self.draw) - 1)
        return speed * np.array([math.cos(turn) * x - math.sin(turn) * y, math.sin(turn) * x + math.cos(turn) * y])
