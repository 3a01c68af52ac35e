"""What M_IN and M_OUT share: the state matrix of group ellipses, outcome and reward (Chapter 4).

The matrix has one row a group (4.2.1), the learning robot's own group first. Centres and goals are relative to the
learning robot, in the world's frame, which is the frame of the headings. Lengths are scaled (`ellipse_scale_per_m`,
`goal_scale_per_m`), angles are in radians. The other groups follow by number from the own one on, which is their
order around the start circle, or by the distance of their centres.

The episode fails where the learning robot has been outside its own ellipse for phi steps running: 4.2.1 and 4.2.3 name
this, the collision and the goal as terminal. Table 4.1 has a row "Lost / Collision" beside "Outside ellipse for phi
steps": with `lost_ends_episode` a robot with none of its own within R2 fails at once, too.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_core.checks import require
from sim_core.config import WorldConfig
from sim_core.episode_end import collision_or_goal, lost_or_captured, sensed
from sim_core.jit import StateKernel, inlined, kernel
from sim_core.methods.apf import FieldParams, field_of, field_params
from sim_core.methods.base import EpisodeParams, Method, Preset, Rule, episode_params
from sim_core.methods.ellipse import (
    NOBODY,
    EllipseParams,
    ellipse_params,
    group_centre,
    group_ellipse,
    in_ellipse,
    left_out_of,
)
from sim_core.methods.headings import heading_velocities
from sim_core.methods.m_sensor import WORLD as SWARM_WORLD
from sim_core.methods.progress import came_closer
from sim_core.outcomes import Outcome
from sim_core.packed import packed
from sim_core.state import WorldState, own_group, world_of

ELLIPSE_COLUMNS = 7
"""a, b, x_c, y_c, theta, x_g, y_g."""
FIELD_COLUMNS = 2
"""u_apf_x, u_apf_y."""
THETA_TOLERANCE = 1e-6
"""An angle above pi / 2 by less, as a share of pi, is pi / 2: float32 cannot tell them apart."""
STEP_REWARD_SHARE = 100.0
"""A step's reward is tau divided by this (Table 4.1)."""

_RUNNING, _GOAL, _TIMEOUT = int(Outcome.RUNNING), int(Outcome.GOAL), int(Outcome.TIMEOUT)


class EllipseMethodParams(NamedTuple):
    """Constants of the ellipse methods."""

    ellipse: EllipseParams
    field: FieldParams
    groups: int
    nearest_first: bool
    ellipse_scale: float
    goal_scale: float
    limit: float
    columns: int
    field_of_all: bool
    episode: EpisodeParams


@kernel
def _order_groups(world, learner, state, order, distance_sq, p):
    """Fills `order` `[groups]`: the own group, then the others as the settings say; `distance_sq` is scratch."""
    pos_x, pos_y = state.pos_x[world], state.pos_y[world]
    own = state.group[learner]
    order[0] = own
    for place in range(1, p.groups):
        group = (own + place) % p.groups
        at = place
        if p.nearest_first:
            x, y, _ = group_centre(state.group_begin[group], state.group_begin[group + 1], pos_x, pos_y, NOBODY)
            dx, dy = x - pos_x[learner], y - pos_y[learner]
            near = dx * dx + dy * dy if x == x else np.inf  # a group that is not sensed is the last one
            while at > 1 and distance_sq[at - 1] > near:
                order[at], distance_sq[at] = order[at - 1], distance_sq[at - 1]
                at -= 1
            distance_sq[at] = near
        order[at] = group


@inlined
def _ellipse_of(group, world, learner, state, ellipses, p):
    """A group's (a, b, x_c, y_c, theta) in metres and radians, as a learning robot has it.

    It is the same for all of a world, but for the learning robot itself where that does not count.

    Args:
      group: the group.
      world: its world.
      learner: the learning robot.
      state: WorldState.
      ellipses: `[groups, 6]`, the last ones found that are the same for all, each with its world.
      p: EllipseMethodParams.
    """
    pos_x, pos_y = state.pos_x[world], state.pos_y[world]
    begin, end = state.group_begin[group], state.group_begin[group + 1]
    left_out, known = left_out_of(learner, p.ellipse), ellipses[group]
    if begin <= left_out < end:
        return group_ellipse(begin, end, pos_x, pos_y, left_out, p.ellipse)
    if known[5] != world:
        known[0], known[1], known[2], known[3], known[4] = group_ellipse(begin, end, pos_x, pos_y, NOBODY, p.ellipse)
        known[5] = world
    return known[0], known[1], known[2], known[3], known[4]


@kernel
def _write_row(group, world, learner, state, out, at, ellipses, p):
    """Writes one group's row to `out[at:at + columns]`."""
    pos_x, pos_y = state.pos_x[world], state.pos_y[world]
    begin, end = state.group_begin[group], state.group_begin[group + 1]
    a, b, x_c, y_c, theta = _ellipse_of(group, world, learner, state, ellipses, p)
    if x_c != x_c:  # none of its robots is sensed: no ellipse, which no half-axis of 0 can be taken for
        a, b, x_c, y_c, theta = 0.0, 0.0, pos_x[learner] + 0.0, pos_y[learner] + 0.0, 0.0
    out[at], out[at + 1] = a * p.ellipse_scale, b * p.ellipse_scale
    out[at + 2] = (x_c - pos_x[learner]) * p.ellipse_scale
    out[at + 3] = (y_c - pos_y[learner]) * p.ellipse_scale
    out[at + 4] = theta
    out[at + 5] = (state.goal_x[world, group] - pos_x[learner]) * p.goal_scale
    out[at + 6] = (state.goal_y[world, group] - pos_y[learner]) * p.goal_scale
    if p.columns > ELLIPSE_COLUMNS:
        if p.field_of_all:
            begin, end = 0, pos_x.shape[0]
        out[at + 7], out[at + 8] = field_of(learner, begin, end, pos_x, pos_y, p.field)
    for i in range(at, at + p.columns):
        out[i] = min(max(out[i], -p.limit), p.limit)


@kernel
def _perceive(state, mask, out, order, distance_sq, ellipses, params):
    p = params[0]
    ellipses[:, 5] = -1.0
    for row in range(mask.shape[0]):
        if not mask[row]:
            continue
        world, learner = world_of(state, row), state.learner[row]
        _order_groups(world, learner, state, order, distance_sq, p)
        for place in range(p.groups):
            _write_row(order[place], world, learner, state, out[row], place * p.columns, ellipses, p)
        out[row, p.groups * p.columns :] = np.float32(0)


@kernel
def _outcome(state, mask, out, ellipses, params):
    p, e = params[0], params[0].episode
    ellipses[:, 5] = -1.0
    for row in range(out.shape[0]):
        if not mask[row]:
            continue
        world, learner = world_of(state, row), state.learner[row]
        pos_x, pos_y = state.pos_x[world], state.pos_y[world]
        group, begin, end = own_group(state, row)
        a, b, x_c, y_c, theta = _ellipse_of(group, world, learner, state, ellipses, p)
        inside = in_ellipse(pos_x[learner], pos_y[learner], a, b, x_c, y_c, theta)
        state.outside_steps[row] = 0 if inside else state.outside_steps[row] + 1
        goal_x, goal_y = state.goal_x[world, group], state.goal_y[world, group]
        ended = collision_or_goal(
            learner, begin, end, pos_x, pos_y, goal_x, goal_y, e.collision_sq, e.outer_m, e.of_centroid
        )
        away = state.outside_steps[row] >= e.outside_limit_steps
        if ended == _RUNNING and e.lost_ends and not away:
            own, _ = sensed(learner, begin, end, pos_x, pos_y, e.outer_sq)
            away = own == 0
        if ended == _RUNNING and away:
            ended = lost_or_captured(learner, begin, end, pos_x, pos_y, e.outer_sq, e.must_surround)
        if ended == _RUNNING and state.steps[world] >= e.horizon_steps:
            ended = _TIMEOUT
        out[row] = ended


@kernel
def _reward(state, mask, outcome, out, params):
    e = params[0].episode
    for row in range(out.shape[0]):
        if not mask[row]:
            continue
        closer = came_closer(state, row) if e.rewards_progress else True
        if outcome[row] == _RUNNING or (outcome[row] == _TIMEOUT and not e.timeout_fails):
            share = e.reward_scale / STEP_REWARD_SHARE
            good = state.outside_steps[row] == 0 and closer
            reward = share if good else -share
        else:
            reward = e.reward_scale if outcome[row] == _GOAL else -e.reward_scale
        out[row] = reward
        state.episode_return[row] += reward


@kernel
def _turn(observation, parts, turns, columns):
    for i in range(observation.shape[0]):
        angle = parts[i] * 2.0 * math.pi / turns
        cos, sin = math.cos(angle), math.sin(angle)
        for at in range(0, observation.shape[1], columns):
            if observation[i, at] == 0:
                continue  # the row of no group
            theta = observation[i, at + 4] + angle
            observation[i, at + 4] = theta - math.pi * math.ceil(theta / math.pi - 0.5 - THETA_TOLERANCE)
            for first in (2, 5, 7):
                if first < columns:
                    x, y = observation[i, at + first], observation[i, at + first + 1]
                    observation[i, at + first] = cos * x - sin * y
                    observation[i, at + first + 1] = sin * x + cos * y


def observation_limit(config: WorldConfig) -> float:
    """A bound of every observation: no robot gets farther from the arena's centre than its speed takes it."""
    travel_m = config.horizon_steps * config.time_step_s * config.top_speed_m_s
    reach_m = config.scene_class.reach_m(config) + travel_m
    offset = 2 * reach_m * max(config.ellipse_scale_per_m, config.goal_scale_per_m)
    spread_m = math.sqrt(2) * reach_m  # the variance of n points is at most n / (n - 1) times the reach squared
    half_axis_m = max(math.sqrt(config.ellipse_chi_square) * spread_m, config.ellipse_smallest_half_axis_m)
    return float(
        np.float32(1.01 * max(offset, half_axis_m * config.ellipse_scale_per_m, config.apf_limit_m_s, math.pi))
    )


COLUMN_NAMES = ("a", "b", "x_c", "y_c", "theta", "x_g", "y_g", "u_apf_x", "u_apf_y")
"""Elements of a group's row; `a` and `b` are the smaller and the larger half-axis."""
ELLIPSE_WORLD: dict[str, Any] = {**SWARM_WORLD, "ellipse_counts_learner": True, "learner_speed_limit_m_s": 1.5}
"""The world of the presets (see `learner.presets`)."""
BEST_WORLD = {**ELLIPSE_WORLD, "ellipse_reward": "progress", "apf_gain_m4_s": 0.05}
TURNED: dict[str, Any] = {"random_turns": True, "teacher_decay_env_steps": 500_000}
"""Settings of training in `best`; each method has a teacher of its own."""
POOLED: dict[str, Any] = {"network": "pooled", "teacher_decay_env_steps": 2_000_000}
"""Settings of training in `generalist`, beside those."""
MOST_GROUPS = 16
"""Groups that a policy of the preset `generalist` can tell apart."""
THESIS = Preset({"samples_per_insert": 4.0}, {**ELLIPSE_WORLD, "captured_is": "surrounded", "lost_ends_episode": True})


class EllipseMethod(Method):
    """State matrix, outcome and reward of the ellipse methods.

    Args:
      config: the setup.
    """

    timeout_fails = True
    draws = frozenset({"ellipses"})
    row_size: ClassVar[int] = ELLIPSE_COLUMNS

    observation_dtype = np.float32

    def __init__(self, config: WorldConfig) -> None:
        super().__init__(config)
        self._end_of_step, self._step_reward = StateKernel(_outcome), StateKernel(_reward)
        self._perceive = StateKernel(_perceive)
        self.observation_limit = observation_limit(config)
        self._order = np.zeros(config.groups, np.int32)
        self._distance_sq = np.zeros(config.groups, np.float64)
        self._ellipses = np.zeros((config.groups, 6))
        self._params = packed(
            EllipseMethodParams(
                ellipse=ellipse_params(config),
                field=field_params(config),
                groups=config.groups,
                nearest_first=config.group_order == "nearest",
                ellipse_scale=float(config.ellipse_scale_per_m),
                goal_scale=float(config.goal_scale_per_m),
                limit=self.observation_limit,
                columns=self.row_size,
                field_of_all=config.apf_rows == "all",
                episode=episode_params(config),
            )
        )

    @classmethod
    def observation_names(cls, config: WorldConfig) -> tuple[str, ...]:
        """A row a group, the own one first."""
        rows = ("own group", *(f"other group {row}" for row in range(1, max(config.groups, config.group_rows))))
        return tuple(f"{row}, {name}" for row in rows for name in COLUMN_NAMES[: cls.row_size])

    @classmethod
    def max_groups(cls, config: WorldConfig) -> int:
        """The rows of the state."""
        return max(config.groups, config.group_rows)

    @classmethod
    def check(cls, config: WorldConfig) -> None:
        """Raises ConfigError where an ellipse has too few robots, or sectors are not in the world's frame."""
        super().check(config)
        require(
            config.ellipse_counts_learner or min(config.group_sizes) >= 3,
            f"robots must be at least 3 per group for method {config.method_name!r}, not {min(config.group_sizes)}: an "
            "ellipse without the learning robot (ellipse_counts_learner) needs two others",
        )
        require(
            config.apf_range_m > 2 * config.robot_radius_m,
            f"apf_range_m ({config.apf_range_m}) must be greater than 2 × robot_radius_m "
            f"({2 * config.robot_radius_m:.3g} m), within which robots have collided",
        )

    @classmethod
    def turns(cls, config: WorldConfig) -> int:
        """A sector at a time; quarter turns where ellipses lie along the axes (`ellipse_covariance`)."""
        return config.sectors if config.ellipse_covariance == "full" else math.gcd(config.sectors, 4)

    def turn(self, observation: NDArray[Any], parts: NDArray[np.int64]) -> None:
        """Turns centres, angles, goals and fields of every row."""
        _turn(observation, parts, self.turns(self.config), self.row_size)

    @classmethod
    def rules(cls, config: WorldConfig) -> dict[str, Rule]:
        """`greedy`: the heading nearest to the direction of the own group's centre; the lowest index among equals."""
        headings = heading_velocities(config, np.float64)[: config.sectors]

        def act(observation: NDArray[Any]) -> NDArray[np.int64]:
            centre = observation[:, 2:4].astype(np.float64)
            return np.asarray(np.argmax(centre @ headings.T, axis=1), np.int64)

        return {"greedy": act}

    def perceive(self, state: WorldState, mask: NDArray[np.bool_], out: NDArray[np.float32]) -> None:
        """4.2.1: the state matrix `[num_rows, rows * row_size]`, row after row."""
        self._perceive(state, mask, out, self._order, self._distance_sq, self._ellipses, self._params)

    def outcome(self, state: WorldState, mask: NDArray[np.bool_], out: NDArray[np.int8]) -> None:
        """4.2.1: goal, collision, lost or captured (see `lost_ends_episode`), timeout; counts `outside_steps`."""
        self._end_of_step(state, mask, out, self._ellipses, self._params)

    def reward(
        self, state: WorldState, mask: NDArray[np.bool_], outcome: NDArray[np.int8], out: NDArray[np.float32]
    ) -> None:
        """Table 4.1: +tau/100 inside the own ellipse (see `ellipse_reward`), -tau/100 outside, +-tau at the end."""
        self._step_reward(state, mask, outcome, out, self._params)
