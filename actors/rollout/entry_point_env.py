"""Environments that step together: a Gymnasium id may register a vector environment of its own, its vector entry point.

Stepping all environments by a few calls of numpy takes a fraction of what Python takes to step one after the other.
"""

from __future__ import annotations

import logging
import warnings
from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from actors.rollout.foreign_env import CheckedVectorEnv, ForeignVectorEnv
from actors.rollout.foreign_spaces import shown


class EntryPointVectorEnv(CheckedVectorEnv):
    """The vector environment that an id registers, whose answers are checked like those of single environments.

    The step after the one that ends an episode starts the next episode and takes no action (`AutoresetMode.NEXT_STEP`).
    An environment waits in that step: `infos["decided"]` is False there, as for a learning robot that waits for its
    world's end.

    Args:
      env_id: the id.
      num_envs: how many environments.
      single: one environment of the id by itself, for its spaces.

    Raises:
      EnvError: it cannot be made.
      ValueError: the id has no vector entry point, or one whose spaces or way of restarting are others.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP}
    num_worlds = 1
    """All environments have one seed."""

    def __init__(self, env_id: str, num_envs: int, single: ForeignVectorEnv) -> None:
        super().__init__(env_id, num_envs)
        self._env = self._make()
        self.envs = [self._env]
        space, actions = single.single_observation_space, single.single_action_space
        assert isinstance(space, gym.spaces.Box) and isinstance(actions, gym.spaces.Discrete)
        theirs = tuple(getattr(self._env, f"single_{name}_space", None) for name in ("observation", "action"))
        if theirs != (space, actions):
            raise ValueError("it has other spaces than a single environment")
        mode, count = self._env.metadata.get("autoreset_mode"), self._env.num_envs
        if mode is not AutoresetMode.NEXT_STEP or count != num_envs:
            raise ValueError(f"it has {count} environments, which restart by {shown(mode)}")
        self._set_spaces(space, actions)
        self._ended = np.zeros(num_envs, np.bool_)

    def _make(self) -> gym.vector.VectorEnv[Any, Any, Any]:
        spec = gym.registry.get(self.env_id.rpartition(":")[2])
        if spec is None or spec.vector_entry_point is None:
            raise ValueError("it has no vector entry point")
        kind = gym.VectorizeMode.VECTOR_ENTRY_POINT
        try:
            with warnings.catch_warnings(action="ignore"):  # of what is checked here, or told of single environments
                return gym.make_vec(self.env_id, num_envs=self.num_envs, vectorization_mode=kind)
        except BaseException as error:
            raise self._raised("make", error) from error

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Starts an episode in every environment.

        Args:
          seed: one for all, or a list of that one.
          options: the environment's own.

        Raises:
          EnvError: see `actors.rollout.foreign_env`.
        """
        own = seed[0] if isinstance(seed, list) else seed
        self._ended = np.zeros(self.num_envs, np.bool_)
        return self._first_observation(own, options), {}

    def _first_observation(self, seed: int | None, options: dict[str, Any] | None) -> NDArray[Any]:
        try:
            result: Any = self._env.reset(seed=seed, options=options)
        except BaseException as error:
            raise self._raised("reset", error) from error
        if type(result) is not tuple or len(result) != 2:
            raise self._refused(f"reset() gave {shown(result)}, where Gymnasium has (observations, infos)")
        observation = self._column("reset", "observations", result[0], self._shape, self.single_observation_space.dtype)
        self._check_finite(observation)
        return observation

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[NDArray[Any], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """One step of every environment; `actions` `[num_envs]`.

        Where an episode ends, the observation is its last, in `infos["final_obs"]`, too, and the next step begins the
        next episode. `infos["decided"]` `[num_envs]` is False where this step did so; it has no reward and no end.

        Raises:
          EnvError: see `actors.rollout.foreign_env`.
        """
        self.steps += 1
        waited = self._ended
        try:
            result: Any = self._env.step(actions)
        except BaseException as error:
            raise self._raised("step", error) from error
        if type(result) is not tuple or len(result) != 5:
            raise self._refused(f"step() gave {shown(result)}, where a vector environment of Gymnasium has 5 values")
        rows = (self.num_envs,)
        observation = self._column("step", "observations", result[0], self._shape, self.single_observation_space.dtype)
        reward = self._column("step", "rewards", result[1], rows).astype(np.float64)
        terminated, truncated = (self._column("step", "flags", flags, rows, np.dtype(bool)) for flags in result[2:4])
        self._check_finite(observation, reward)
        if waited.any():
            reward[waited], terminated[waited], truncated[waited] = 0.0, False, False
        self._ended = terminated | truncated
        infos: dict[str, Any] = {"decided": ~waited}
        if self._ended.any():
            infos |= {"final_obs": observation, "_final_obs": self._ended}
        return observation, reward, terminated, truncated, infos

    def _column(
        self, doing: str, what: str, value: Any, shape: tuple[int, ...], dtype: np.dtype[Any] | None = None
    ) -> NDArray[Any]:
        """A copy of what the environment gave, of this shape, and of this dtype or any that is a number's."""
        if not isinstance(value, np.ndarray) or value.shape != shape or value.dtype.kind not in "biuf":
            raise self._refused(f"{doing}() gave the {what} {shown(value)}, where there must be numbers {shape}")
        if dtype is not None and value.dtype != dtype:
            raise self._refused(f"{doing}() gave {what} of dtype {value.dtype}, where there must be {dtype}")
        return value.copy()

    def waiting(self) -> NDArray[np.bool_]:
        """Which environments begin an episode in the next step, and take no action there `[num_envs]`."""
        return self._ended.copy()


def foreign_rollout_env(env_id: str, num_envs: int) -> EntryPointVectorEnv | ForeignVectorEnv:
    """Environments of one Gymnasium id: by its vector entry point where it has one, else one after the other.

    A vector entry point that cannot be made here, or that differs from single environments in its spaces, is left out.
    Single environments restart in the step that ends an episode.

    Raises:
      EnvError: single environments cannot be made either.
    """
    with closing(ForeignVectorEnv(env_id, 1)) as single:
        try:
            return EntryPointVectorEnv(env_id, num_envs, single)
        except KeyboardInterrupt:
            raise
        except Exception as error:
            logging.getLogger(__name__).info("env_id %r: steps one after the other, since %s", env_id, error)
    return ForeignVectorEnv(env_id, num_envs)
