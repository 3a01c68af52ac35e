"""What a scene is: the sizes of the groups, and where robots start and go in each episode.

A scene of your own derives from `Scene`, lies in a file of its own and is named `FILE.py:CLASS`. It needs `place`;
everything else has a default.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_core.config import WorldConfig
from sim_core.plugins import guarded, refuse
from sim_core.rng import fill_uniform
from sim_core.state import WorldState

Uniform = Callable[[int], NDArray[np.float64]]
"""The next so many draws in [0, 1) of a world's own random stream."""
GOAL_HALF_SIDE_M = 0.35
"""Half the edge of a goal as it is drawn."""
DRAWN_MARGIN_M = 0.3


class Start(NamedTuple):
    """The start of an episode in one world.

    Attributes:
      position: `[num_robots, 2]`, metres; the robots of group 0 first, then those of group 1, ...
      goal: `[groups, 2]`, metres.
      learner: index of the learning robot; None draws it from all robots alike.
    """

    position: NDArray[np.floating]
    goal: NDArray[np.floating]
    learner: int | None = None


class Scene:
    """Start positions, goals and the learning robot's place.

    Args:
      config: the world.
    """

    draws_circle: ClassVar[bool] = False
    """Whether pictures show the circle of `arena_radius_m`."""

    def __init__(self, config: WorldConfig) -> None:
        self.config = config

    @classmethod
    def group_sizes(cls, config: WorldConfig) -> tuple[int, ...]:
        """Robots of each group, `config.groups` numbers; `config.robots` in every group unless a scene says else."""
        return (config.robots,) * config.groups

    @classmethod
    def check(cls, config: WorldConfig) -> None:
        """Raises ConfigError where a setting cannot work in this scene."""

    @classmethod
    def reach_m(cls, config: WorldConfig) -> float:
        """Farthest distance of a start or goal from the point (0, 0), metres."""
        return config.arena_radius_m

    @classmethod
    def view_half_m(cls, config: WorldConfig) -> float:
        """Half the edge of the square that pictures show, metres."""
        return cls.reach_m(config) + max(config.robot_radius_m, GOAL_HALF_SIDE_M) + DRAWN_MARGIN_M

    def place(self, uniform: Uniform) -> Start:
        """Where an episode of one world starts.

        Args:
          uniform: draws from the world's own random stream; use no other, or an episode's seed would not decide it.
        """
        raise NotImplementedError(f"{type(self).__name__} must define place(self, uniform)")

    def start(self, state: WorldState, mask: NDArray[np.bool_]) -> None:
        """Writes positions, velocities, goals and learning robots of the worlds where `mask` `[num_worlds]` is set."""
        for world in np.flatnonzero(mask):
            draws = functools.partial(_draw, state, int(world))
            position, goal, learner = self.place(draws)
            state.pos_x[world], state.pos_y[world] = _columns("position", position, self.config.num_robots)
            state.goal_x[world], state.goal_y[world] = _columns("goal", goal, self.config.groups)
            state.vel_x[world] = state.vel_y[world] = 0.0
            drawn = int(draws(1)[0] * self.config.num_robots)
            state.learner[world] = drawn if learner is None else learner


def _draw(state: WorldState, world: int, count: int) -> NDArray[np.float64]:
    values = np.empty(count)
    fill_uniform(state.rng, world, values)
    return values


def _columns(name: str, points: Any, count: int) -> NDArray[np.float64]:
    """The points `[count, 2]` as columns `[2, count]`."""
    array = np.asarray(points, np.float64)
    if array.shape != (count, 2):
        raise ValueError(f"{name} has the shape {array.shape}, not {(count, 2)}")
    return array.T


class CheckedScene(Scene):
    """A user's own scene, whose errors name its file and line, and whose starts are checked.

    Args:
      config: the world.
    """

    def __init__(self, config: WorldConfig) -> None:
        super().__init__(config)
        self._cls = config.scene_class
        with guarded(self._cls, "__init__"):
            self._scene: Scene = self._cls(config)

    def start(self, state: WorldState, mask: NDArray[np.bool_]) -> None:
        """As `Scene.start`.

        Raises:
          PluginError: the scene raised, or gave what cannot be a start.
        """
        doing = "place" if self._cls.start is Scene.start else "start"
        with guarded(self._cls, doing):
            self._scene.start(state, mask)
        problem = _problem(state, mask, self.config)
        if problem:
            raise refuse(self._cls, doing, problem)


def _problem(state: WorldState, mask: NDArray[np.bool_], config: WorldConfig) -> str:
    """What is wrong with the starts of the worlds where `mask` is set; empty if nothing is."""
    position = np.stack([state.pos_x[mask], state.pos_y[mask]], axis=-1)
    goal, learner = np.stack([state.goal_x[mask], state.goal_y[mask]]), state.learner[mask]
    if not (np.isfinite(position).all() and np.isfinite(goal).all()):
        return "gave a position or goal that is not finite"
    if ((learner < 0) | (learner >= config.num_robots)).any():
        return f"gave a learning robot that is none of 0..{config.num_robots - 1}"
    for start in position:
        apart_m = np.linalg.norm(start[:, None] - start[None], axis=-1)
        np.fill_diagonal(apart_m, np.inf)
        i, j = divmod(int(apart_m.argmin()), len(start))
        if apart_m[i, j] < 2 * config.robot_radius_m:
            return f"put robots {i} and {j} {apart_m[i, j]:.3g} m apart; robot_radius_m is {config.robot_radius_m}"
    return ""
