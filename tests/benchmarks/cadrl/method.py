"""GA3C-CADRL as a driver of our learning robot, which it takes to its group's centre: methods with one rule.

`greedy` is the published network, which learns nothing here. It sees positions and velocities of the 19 nearest robots,
which the dissertation's methods do not, and takes an action every 0.2 s, as it was trained: a speed and a turn. How
large robots and lengths are for it (`radius_field`, `enlarged`) is the best of six readings, two radii and factors of 1
to 3, on start scenes that no league plays.
"""

import numpy as np

from sim_core.checks import require
from sim_core.methods.base import Method
from sim_core.methods.m_in import InsideMethod
from tests.benchmarks.cadrl.network import (
    INPUTS,
    MOST_OTHERS,
    OTHER_VALUES,
    OWN_VALUES,
    SPEEDS,
    TURNS_RAD,
    action_logits,
    published_weights,
)

CREEP_M_S = 1e-3
"""Speed of an action that stands, so that the velocity keeps the heading."""


def group_offset(state):
    """Vectors `[num_worlds, 2]` (m) from the learning robots to the centres of their groups' other robots."""
    own = state.group == state.group[state.learner][:, None]
    own[np.arange(len(own)), state.learner] = False
    return np.stack([np.mean(p, 1, where=own) - _of_learner(p, state) for p in (state.pos_x, state.pos_y)], axis=1)


def headings_rad(state):
    """Directions `[num_worlds]` in which the learning robots face: of their velocity, at the start of their goal."""
    x, y = group_offset(state).T
    vx, vy = _of_learner(state.vel_x, state), _of_learner(state.vel_y, state)
    moves = (vx != 0) | (vy != 0)
    return np.arctan2(np.where(moves, vy, y), np.where(moves, vx, x))


def _of_learner(values, state):
    return np.take_along_axis(values, state.learner[:, None], axis=1)[:, 0]


class _Driven(Method):
    """What both methods share: the published network's observation, actions and rule."""

    label = "GA3C-CADRL"
    radius_field = "robot_radius_m"
    """Setting of the world that it takes for every robot's radius."""
    enlarged = 2.0
    """Factor of all lengths and speeds that it is shown: our robots are smaller than those that it was trained with."""
    fits_any_groups = True
    row_size = 0
    draws = frozenset()
    robot_module = ""

    @classmethod
    def check(cls, config):
        require(
            config.num_actions == len(SPEEDS),
            f"GA3C-CADRL has {len(SPEEDS)} actions, so set sectors to that, not to {config.sectors}",
        )
        require(not config.senses_badly, "GA3C-CADRL must sense all robots")

    @classmethod
    def turns(cls, config):
        return 1

    @classmethod
    def observation_names(cls, config):
        own = ("others", "distance", "heading", "speed", "radius")
        each = ("along", "across", "v along", "v across", "radius", "radii", "gap")
        return own + tuple(f"{name} {place}" for place in range(MOST_OTHERS) for name in each)

    @classmethod
    def rules(cls, config):
        return {"greedy": lambda observation: np.argmax(action_logits(observation, published_weights()), axis=1)}

    perceive = Method.perceive

    def observe(self, state):
        goal = group_offset(state).astype(np.float64)
        rows, radius_m = len(goal), getattr(self.config, self.radius_field)
        distance_m = np.linalg.norm(goal, axis=1)
        along = goal / np.maximum(distance_m, 1e-8)[:, None]
        across = np.stack([-along[:, 1], along[:, 0]], axis=1)
        turn = headings_rad(state) - np.arctan2(goal[:, 1], goal[:, 0])
        out = np.zeros((rows, INPUTS), np.float32)
        others = self._others(state, along, across, radius_m)
        count = others.shape[1]
        out[:, 1] = distance_m
        out[:, 3] = self.config.learner_speed_m_s
        out[:, 4] = radius_m
        out[:, 1 + OWN_VALUES : 1 + OWN_VALUES + count * OTHER_VALUES] = others.reshape(rows, -1)
        out *= self.enlarged
        out[:, 0] = count
        out[:, 2] = (turn + np.pi) % (2 * np.pi) - np.pi
        return out

    def _others(self, state, along, across, radius_m):
        """Values `[num_worlds, others, 7]` of the nearest other robots, the nearest last."""
        away = np.arange(state.pos_x.shape[1]) != state.learner[:, None]

        def seen(x, y):
            vector = np.stack([x, y], axis=2).astype(np.float64)
            return np.einsum("wrc,wc->wr", vector, along), np.einsum("wrc,wc->wr", vector, across)

        x, y = (p - _of_learner(p, state)[:, None] for p in (state.pos_x, state.pos_y))
        p_along, p_across = seen(x, y)
        v_along, v_across = seen(state.vel_x, state.vel_y)
        gap_m = np.hypot(p_along, p_across) - 2 * radius_m
        # Gaps are compared to the centimetre and then by side, as the network was trained.
        key = np.where(away, np.round(gap_m, 2), np.inf)
        order = np.lexsort((p_across, key), axis=1)[:, : min(MOST_OTHERS, away.shape[1] - 1)]
        farthest_first = np.lexsort((p_across, -key), axis=1)
        chosen = np.zeros(away.shape, bool)
        np.put_along_axis(chosen, order, True, axis=1)
        rows = np.take_along_axis(chosen, farthest_first, axis=1)
        order = farthest_first[rows].reshape(order.shape)
        radius = np.full_like(gap_m, radius_m)
        columns = (p_along, p_across, v_along, v_across, radius, 2 * radius, gap_m)
        return np.stack([np.take_along_axis(column, order, axis=1) for column in columns], axis=2)

    def velocity(self, state, action, out_x, out_y):
        """An action turns at once and drives for a decision; see `Method.velocity`."""
        begins = state.steps % self.config.decision_interval_steps == 0
        speed = np.maximum(SPEEDS[action] * self.config.learner_speed_m_s, CREEP_M_S)
        heading = headings_rad(state) + TURNS_RAD[action]
        out_x[:] = np.where(begins, speed * np.cos(heading), _of_learner(state.vel_x, state))
        out_y[:] = np.where(begins, speed * np.sin(heading), _of_learner(state.vel_y, state))


class Driven(_Driven):
    """In M_sensor's world, with its ends of an episode."""

    swarm_knows_learner = True


class DrivenInEllipse(_Driven, InsideMethod):
    """In the world of M_IN and M_OUT, with their ends of an episode."""

    radius_field = "orca_radius_m"
    enlarged = 3.0
    swarm_knows_learner = False
    timeout_fails = True
