"""What a method is: one class that says everything about one state representation of the learning robot.

A method of your own derives from `Method`, lies in a file of its own and is named `FILE.py:CLASS`. It needs
`observation_names` and `observe`; the rest has defaults: headings as actions, M_sensor's outcome and reward.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_core.checks import require
from sim_core.config import MAX_ROBOTS, WorldConfig
from sim_core.episode_end import end_of_step
from sim_core.jit import StateKernel, kernel
from sim_core.methods.headings import heading_velocities, turn_headings, write_headings
from sim_core.methods.progress import came_closer
from sim_core.outcomes import Outcome
from sim_core.packed import packed
from sim_core.plugins import guarded, refuse
from sim_core.state import WorldState, own_group, world_of

_GOAL, _RUNNING, _TIMEOUT = int(Outcome.GOAL), int(Outcome.RUNNING), int(Outcome.TIMEOUT)

Rule = Callable[[NDArray[Any]], NDArray[np.int64]]
"""Observations `[batch, *observation_shape]` to actions `[batch]`."""


class Preset(NamedTuple):
    """What a preset of `learner.presets` sets for one method: fields of the training and of the world."""

    training: Mapping[str, Any]
    world: Mapping[str, Any]


class EpisodeParams(NamedTuple):
    """Constants of how an episode ends and what a step is worth."""

    outer_m: Any
    outer_sq: Any
    collision_sq: Any
    of_centroid: bool
    must_surround: bool
    outside_limit_steps: int
    lost_ends: bool
    horizon_steps: int
    timeout_fails: bool
    reward_scale: float
    clock_is_step: bool
    rewards_progress: bool


def episode_params(config: WorldConfig) -> EpisodeParams:
    """The constants of `config`."""
    real = np.float32
    return EpisodeParams(
        outer_m=real(config.outer_radius_m),
        outer_sq=real(config.outer_radius_m) ** 2,
        collision_sq=real(2 * config.robot_radius_m) ** 2,
        of_centroid=config.group_distance == "centroid",
        must_surround=config.captured_is == "surrounded",
        outside_limit_steps=config.outside_limit_steps,
        lost_ends=config.lost_ends_episode,
        horizon_steps=config.horizon_steps,
        timeout_fails=config.timeout_fails,
        reward_scale=float(config.reward_scale),
        clock_is_step=config.reward_clock == "step",
        rewards_progress=config.ellipse_reward == "progress",
    )


@kernel
def _outcome(state, mask, out, params):
    p = params[0]
    for row in range(out.shape[0]):
        if not mask[row]:
            continue
        world = world_of(state, row)
        group, begin, end = own_group(state, row)
        ended = end_of_step(
            state.learner[row],
            begin,
            end,
            state.pos_x[world],
            state.pos_y[world],
            state.goal_x[world, group],
            state.goal_y[world, group],
            p.collision_sq,
            p.outer_m,
            p.of_centroid,
            p.must_surround,
        )
        if ended == _RUNNING and state.steps[world] >= p.horizon_steps:
            ended = _TIMEOUT
        out[row] = ended


@kernel
def _reward(state, mask, outcome, out, params):
    p = params[0]
    for row in range(out.shape[0]):
        if not mask[row]:
            continue
        closer = came_closer(state, row)
        if outcome[row] == _RUNNING or (outcome[row] == _TIMEOUT and not p.timeout_fails):
            clock = state.steps[world_of(state, row)] if p.clock_is_step else p.horizon_steps
            reward = p.reward_scale / clock if closer else -p.reward_scale / clock
        else:
            reward = p.reward_scale if outcome[row] == _GOAL else -p.reward_scale
        out[row] = reward
        state.episode_return[row] += reward


class Method:
    """State representation, velocity, reward and outcome of the learning robots.

    `num_rows` below counts learning robots, world after world: worlds, where one robot of each learns. A built-in
    method's kernels find a row's world with `sim_core.state.world_of`; a method of a user's own always gets a state in
    which every row is a world of its own (see `CheckedMethod`).

    Attributes:
      observation_dtype: dtype of an observation; float32 by default.
      observation_limit: largest absolute value in an observation; larger ones are cut by `perceive`'s default.

    Args:
      config: the world.
    """

    label: ClassVar[str] = ""
    """Name in pictures and tables; the class's by default."""
    swarm_knows_learner: ClassVar[bool] = False
    """Whether the swarm avoids the learning robot and counts it in its flock, unless the world says otherwise."""
    timeout_fails: ClassVar[bool] = False
    """Whether a timeout is a terminal failure, unless the world says otherwise; else it cuts the episode."""
    fits_any_groups: ClassVar[bool] = False
    """Whether an observation has the same size for every number of groups, so that a policy can be tested there."""
    row_size: ClassVar[int] = 0
    """Elements of a row, where an observation is rows of groups, the own one first and absent ones zero; else 0."""
    draws: ClassVar[frozenset[str]] = frozenset()
    """What the player draws of the state: `sectors`, `ellipses`."""
    presets: ClassVar[Mapping[str, Preset]] = {}
    """What the presets `thesis` and `best` set; a method without takes M_sensor's."""
    robot_module: ClassVar[str] = ""
    """`module:class` of the exported decision, from positions to velocity (learner/export); without one, the policy
    is exported from its observation on."""

    observation_dtype: Any = np.float32
    observation_limit: float = 1e6

    def __init__(self, config: WorldConfig) -> None:
        self.config = config
        self.observation_shape: tuple[int, ...] = (len(self.observation_names(config)),)
        self.headings = heading_velocities(config, np.float32)
        self.episode_params = packed(episode_params(config))
        self._end_of_step, self._step_reward = StateKernel(_outcome), StateKernel(_reward)

    @classmethod
    def observation_names(cls, config: WorldConfig) -> tuple[str, ...]:
        """Names of an observation's elements, whose number is its size."""
        raise NotImplementedError(f"{cls.__name__} must define observation_names(cls, config)")

    @classmethod
    def max_groups(cls, config: WorldConfig) -> int:
        """Most groups for which an observation has the size that it has in `config`, so that a policy fits there."""
        return MAX_ROBOTS if cls.fits_any_groups else config.groups

    @classmethod
    def turns(cls, config: WorldConfig) -> int:
        """Equal parts of a full turn by which observation and heading may be turned together; they divide `sectors`.

        A turned world is another world of the same kind, so a turned transition is another one (data augmentation).
        1, the default, is for methods that do not say how an observation turns.
        """
        return 1

    @classmethod
    def check(cls, config: WorldConfig) -> None:
        """Raises ConfigError where a setting cannot work with this method."""
        require(
            config.sector_frame == "world",
            f"sector_frame must be 'world' for method {config.method_name!r}, whose state is in the world's frame",
        )

    @classmethod
    def top_speed_m_s(cls, config: WorldConfig) -> float:
        """Largest speed of the learning robot."""
        return config.learner_speed_m_s

    @classmethod
    def rules(cls, config: WorldConfig) -> dict[str, Rule]:
        """Rules on the observation that learn nothing, to measure policies against: `greedy` and `field`, or fewer."""
        return {}

    def observe(self, state: WorldState) -> NDArray[Any]:
        """Observations `[num_rows, size]` of all rows, in plain numpy; a method with kernels defines `perceive`.

        `state` is what the learning robots sense (`sim_core.senses`): a robot that is not sensed is at NaN.
        """
        raise NotImplementedError(f"{type(self).__name__} must define observe(self, state)")

    def perceive(self, state: WorldState, mask: NDArray[np.bool_], out: NDArray[Any]) -> None:
        """Writes observations `[num_rows, *observation_shape]` of the rows where `mask` is set; see `observe`."""
        seen = np.asarray(self.observe(state))
        if seen.shape != out.shape:
            raise ValueError(f"observations of shape {seen.shape}, not {out.shape}")
        np.copyto(out, np.clip(seen, -self.observation_limit, self.observation_limit), "unsafe", where=mask[:, None])

    def turn(self, observation: NDArray[Any], parts: NDArray[np.int64]) -> None:
        """Turns observations `[batch, size]` in place, each counter-clockwise by `parts` `[batch]` of `turns` parts."""
        raise NotImplementedError(f"{type(self).__name__} must define turn(self, observation, parts), as it has turns")

    def turn_actions(self, action: NDArray[Any], parts: NDArray[np.int64]) -> None:
        """Turns the headings among actions `[batch]` in place, as `turn` does; a stop stays."""
        sectors, levels = self.config.sectors, self.config.speed_levels
        turn_headings(action, parts, sectors // self.turns(self.config), sectors, levels)

    def velocity(self, state: WorldState, action: NDArray[np.int64], out_x: Any, out_y: Any) -> None:
        """Writes the learning robots' velocities `[num_rows]` (m/s) for `action` `[num_rows]`: u_nn of Eq. 3.4.

        `state` is what the learning robots sense.

        Raises:
          ValueError: there is not one action a row, or one is none of the actions.
        """
        write_headings(self.headings, action, out_x, out_y)

    def outcome(self, state: WorldState, mask: NDArray[np.bool_], out: NDArray[np.int8]) -> None:
        """Writes the Outcome `[num_rows]` after a simulator step of the rows where `mask` is set.

        It is called once a step, so it may count steps.

        By default that of 3.2.1: goal, collision, lost or captured as soon as no own robot is sensed; timeout at the
        horizon.
        """
        self._end_of_step(state, mask, out, self.episode_params)

    def reward(
        self, state: WorldState, mask: NDArray[np.bool_], outcome: NDArray[np.int8], out: NDArray[np.float32]
    ) -> None:
        """Writes the rewards `[num_rows]` of a simulator step of the rows where `mask` is set.

        It adds them to `state.episode_return`.

        By default Table 3.1, with the robot's own distance to the goal as "closer"; a timeout that is no failure is a
        step.
        """
        self._step_reward(state, mask, outcome, out, self.episode_params)


class CheckedMethod(Method):
    """A user's own method, whose errors name its file and line, and whose results are checked.

    Args:
      config: the world.
    """

    def __init__(self, config: WorldConfig) -> None:
        self._cls = config.method_class
        with guarded(self._cls, "__init__"):
            self._method: Method = self._cls(config)
        self.config = config
        self.observation_shape = self._method.observation_shape
        self.observation_dtype = np.dtype(self._method.observation_dtype)
        self.observation_limit = float(self._method.observation_limit)
        self.row_size = self._cls.row_size  # type: ignore[misc]  # of the user's class, here of an instance
        self._is_float = np.issubdtype(self.observation_dtype, np.floating)
        self._top_speed_m_s = config.top_speed_m_s

    def perceive(self, state: WorldState, mask: NDArray[np.bool_], out: NDArray[Any]) -> None:
        """As `Method.perceive`.

        Raises:
          PluginError: the user's code raised, or gave an observation that is not finite or beyond its limit.
        """
        overrides = self._cls.perceive is not Method.perceive
        doing = "perceive" if overrides else "observe"
        with guarded(self._cls, doing):
            self._method.perceive(state, mask, out)
        if self._is_float and not np.isfinite(out).all():
            hint = "; robots that the learning robot does not sense are at NaN" if self.config.senses_badly else ""
            raise refuse(self._cls, doing, f"gave an observation that is not finite{hint}")
        if np.abs(out).max(initial=0) > self.observation_limit:
            raise refuse(self._cls, doing, f"gave an observation beyond observation_limit = {self.observation_limit}")

    def velocity(self, state: WorldState, action: NDArray[np.int64], out_x: Any, out_y: Any) -> None:
        """As `Method.velocity`.

        Raises:
          PluginError: the user's code raised, or gave a velocity that is not finite or too fast.
        """
        with guarded(self._cls, "velocity"):
            self._method.velocity(state, action, out_x, out_y)
        fastest = float(np.sqrt(np.square(out_x) + np.square(out_y)).max(initial=0.0))
        if not fastest <= 1.001 * self._top_speed_m_s:
            raise refuse(
                self._cls, "velocity", f"gave a speed of {fastest:.3g} m/s, beyond top_speed_m_s {self._top_speed_m_s}"
            )

    def outcome(self, state: WorldState, mask: NDArray[np.bool_], out: NDArray[np.int8]) -> None:
        """As `Method.outcome`.

        Raises:
          PluginError: the user's code raised, or gave what is no Outcome.
        """
        with guarded(self._cls, "outcome"):
            self._method.outcome(state, mask, out)
        if out.min(initial=0) < 0 or out.max(initial=0) >= len(Outcome):
            raise refuse(self._cls, "outcome", f"gave {sorted(set(out.tolist()))}, not all of sim_core.Outcome")

    def reward(
        self, state: WorldState, mask: NDArray[np.bool_], outcome: NDArray[np.int8], out: NDArray[np.float32]
    ) -> None:
        """As `Method.reward`.

        Raises:
          PluginError: the user's code raised, or gave a reward that is not finite.
        """
        with guarded(self._cls, "reward"):
            self._method.reward(state, mask, outcome, out)
        if not np.isfinite(out).all():
            raise refuse(self._cls, "reward", "gave a reward that is not finite")

    def turn(self, observation: NDArray[Any], parts: NDArray[np.int64]) -> None:
        """As `Method.turn`.

        Raises:
          PluginError: the user's code raised.
        """
        with guarded(self._cls, "turn"):
            self._method.turn(observation, parts)

    def turn_actions(self, action: NDArray[Any], parts: NDArray[np.int64]) -> None:
        """As `Method.turn_actions`."""
        self._method.turn_actions(action, parts)
