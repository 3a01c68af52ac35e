"""The environments of rollout workers and evaluators: any Gymnasium id, as a `VectorEnv`."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from sim_core import ENV_ID
from sim_core.checks import ConfigError
from sim_core.config import WorldConfig
from sim_core.worlds import rehearse


class EnvSpec(NamedTuple):
    """Which environment: a Gymnasium id, and the world if it is ours."""

    env_id: str
    world: WorldConfig

    @property
    def is_swarm(self) -> bool:
        """Whether this is our own environment."""
        return self.env_id == ENV_ID

    @property
    def settings(self) -> dict[str, Any]:
        """Keyword arguments of Gymnasium's `make` and `make_vec`."""
        return dataclasses.asdict(self.world) if self.is_swarm else {}


def make_vector_env(spec: EnvSpec, num_envs: int) -> gym.vector.VectorEnv[Any, Any, Any]:
    """`num_envs` environments that restart in the same step (`AutoresetMode.SAME_STEP`).

    Raises:
      ConfigError: the id is unknown, or its spaces are not a Box and a Discrete from 0.
    """
    try:
        if spec.is_swarm:
            env = gym.make_vec(ENV_ID, num_envs=num_envs, **spec.settings)
        else:
            mode = {"autoreset_mode": AutoresetMode.SAME_STEP}
            env = gym.make_vec(spec.env_id, num_envs=num_envs, vectorization_mode="sync", vector_kwargs=mode)
    except (gym.error.Error, ModuleNotFoundError) as error:
        raise ConfigError(f"env_id {spec.env_id!r} cannot be made by Gymnasium: {error}") from error
    _check_spaces(env, spec.env_id)
    return env


def reset_seeded(env: gym.vector.VectorEnv[Any, Any, Any], seeds: list[int]) -> NDArray[Any]:
    """First observations `[num_envs, ...]` of new episodes, environment i from `seeds[i]`."""
    observation: NDArray[Any] = env.reset(seed=seeds)[0]  # type: ignore[arg-type]  # every VectorEnv takes a list
    return observation


def spaces_of(env: gym.vector.VectorEnv[Any, Any, Any]) -> EnvShape:
    """The spaces of environments that `make_vector_env` made."""
    space, actions = env.single_observation_space, env.single_action_space
    assert isinstance(space, gym.spaces.Box) and isinstance(actions, gym.spaces.Discrete)
    return EnvShape(space, int(actions.n))


def _check_spaces(env: gym.vector.VectorEnv[Any, Any, Any], env_id: str) -> None:
    if not isinstance(env.single_observation_space, gym.spaces.Box):
        raise ConfigError(f"env_id {env_id!r} must have Box observations, not {env.single_observation_space}")
    action_space = env.single_action_space
    if not isinstance(action_space, gym.spaces.Discrete) or action_space.start != 0:
        raise ConfigError(f"env_id {env_id!r} must have Discrete actions from 0, not {action_space}")


class EnvShape(NamedTuple):
    """Spaces of an environment, as the network and the replay need them."""

    observation_space: gym.spaces.Box
    num_actions: int

    @property
    def observation_size(self) -> int:
        """Number of elements of one observation."""
        return int(np.prod(self.observation_space.shape))


def env_shape(spec: EnvSpec) -> EnvShape:
    """The spaces of `spec`, found by making one environment; a user's own method or scene is rehearsed first.

    Raises:
      ConfigError: see `make_vector_env`, or the rehearsal shows an error in the user's code.
    """
    if spec.is_swarm:
        rehearse(spec.world)
    env = make_vector_env(spec, 1)
    try:
        return spaces_of(env)
    finally:
        env.close()


def final_observations(observation: NDArray[Any], done: NDArray[np.bool_], infos: dict[str, Any]) -> NDArray[Any]:
    """The states that a step reached: `observation`, with the ended episodes' last ones put in."""
    if not done.any():
        return observation
    reached = observation.copy()
    final = infos["final_obs"][done]
    reached[done] = final if final.dtype == observation.dtype else np.stack(list(final))  # Gymnasium's are objects
    return reached
