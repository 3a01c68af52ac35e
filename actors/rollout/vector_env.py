"""Vector environments for rollout workers and evaluators, from any Gymnasium id."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from actors.rollout.entry_point_env import EntryPointVectorEnv, foreign_rollout_env
from actors.rollout.env_spec import EnvSpec
from actors.rollout.foreign_env import ForeignVectorEnv, rehearse_env
from actors.rollout.joined_env import JoinedVectorEnv
from sim_core import ENV_ID
from sim_core.envs import SwarmVectorEnv
from sim_core.worlds import rehearse


def make_vector_env(spec: EnvSpec, num_envs: int) -> gym.vector.VectorEnv[Any, Any, Any]:
    """Makes `num_envs` environments that restart in the step that ends an episode (`AutoresetMode.SAME_STEP`).

    Where several robots of a world learn, an environment is a learning robot, and the number `EnvSpec.counts`.

    Raises:
      ConfigError: see ForeignVectorEnv, which holds all environments that are not ours.
    """
    if spec.shares:
        return JoinedVectorEnv(
            [
                SwarmVectorEnv(count, **dataclasses.asdict(world))
                for world, count in zip(spec.worlds, spec.counts(num_envs), strict=True)
            ]
        )
    if spec.is_swarm:
        return gym.make_vec(ENV_ID, num_envs=spec.counts(num_envs)[0], **spec.settings)
    return ForeignVectorEnv(spec.env_id, num_envs)


def make_rollout_env(spec: EnvSpec, num_envs: int) -> gym.vector.VectorEnv[Any, Any, Any]:
    """As `make_vector_env`, but environments that are not ours step together where their id allows that.

    Those may need no seed each, and restart one step later (`EntryPointVectorEnv`).

    Raises:
      ConfigError: see `make_vector_env`.
    """
    return make_vector_env(spec, num_envs) if spec.is_swarm else foreign_rollout_env(spec.env_id, num_envs)


def num_worlds_of(env: gym.vector.VectorEnv[Any, Any, Any]) -> int:
    """What has a seed each: worlds, of which a learning robot is a row; environments that step together have one."""
    return env.num_worlds if isinstance(env, SwarmVectorEnv | JoinedVectorEnv | EntryPointVectorEnv) else env.num_envs


def reset_seeded(env: gym.vector.VectorEnv[Any, Any, Any], seeds: list[int]) -> NDArray[Any]:
    """Resets world i with `seeds[i]` (`num_worlds_of`); returns the first observations `[num_envs, ...]`."""
    observation: NDArray[Any] = env.reset(seed=seeds)[0]  # type: ignore[arg-type]  # every VectorEnv takes a list
    return observation


def spaces_of(env: gym.vector.VectorEnv[Any, Any, Any]) -> EnvShape:
    """Spaces of environments that `make_vector_env` made."""
    space, actions = env.single_observation_space, env.single_action_space
    assert isinstance(space, gym.spaces.Box) and isinstance(actions, gym.spaces.Discrete)
    return EnvShape(space, int(actions.n))


class EnvShape(NamedTuple):
    """Spaces of one environment, as the network and the replay need them."""

    observation_space: gym.spaces.Box
    num_actions: int

    @property
    def observation_size(self) -> int:
        """Number of elements of one observation."""
        return int(np.prod(self.observation_space.shape))


def env_shape(spec: EnvSpec) -> EnvShape:
    """Spaces of `spec`, read from one environment that is made for this; whatever is a user's own is rehearsed.

    Raises:
      ConfigError: see `make_vector_env`; also if the rehearsal finds an error in the user's code.
    """
    if not spec.is_swarm:
        observations, actions = rehearse_env(spec.env_id)
        return EnvShape(observations, int(actions.n))
    for world in spec.worlds:
        rehearse(world)
    env = make_vector_env(spec, sum(spec.learners()))
    try:
        return spaces_of(env)
    finally:
        env.close()


def final_observations(observation: NDArray[Any], done: NDArray[np.bool_], infos: dict[str, Any]) -> NDArray[Any]:
    """Next observations of a step, without the effect of restarts.

    Args:
      observation: what the step returned `[num_envs, ...]`; the first observation of a new episode where `done`.
      done: where an episode ended `[num_envs]`.
      infos: what the step returned; `final_obs` holds the last observations of ended episodes.

    Returns:
      `observation` itself if no episode ended, else a copy with the last observations of ended episodes.
    """
    if not done.any():
        return observation
    next_observation = observation.copy()
    next_observation[done] = infos["final_obs"][done]
    return next_observation
