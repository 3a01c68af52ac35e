"""Swarm environments of several setups as one vector environment, so that one policy acts in all of them."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from sim_core.envs import SwarmVectorEnv
from sim_core.reset_arguments import RESET_MASK, env_seeds, reset_mask

Arrays = dict[str, NDArray[Any]]


class JoinedVectorEnv(gym.vector.VectorEnv[NDArray[Any], NDArray[np.int64], NDArray[Any]]):
    """Vector environments with equal spaces, one after the other; each restarts its worlds in the same step.

    Args:
      parts: the environments.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, parts: list[SwarmVectorEnv]) -> None:
        self._parts = parts
        self._ends = np.cumsum([part.num_envs for part in parts])[:-1]
        self.num_envs = sum(part.num_envs for part in parts)
        self.num_worlds = sum(part.num_worlds for part in parts)
        self.single_observation_space = parts[0].single_observation_space
        self.single_action_space = parts[0].single_action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Starts episodes as `SwarmVectorEnv.reset` does (see there for errors); a seed and a mask's entry a world."""
        seeds, mask = env_seeds(seed, self.num_worlds), reset_mask(options, self.num_worlds)
        ends = np.cumsum([part.num_worlds for part in self._parts])[:-1]
        masks = np.split(np.ones(self.num_worlds, np.bool_) if mask is None else mask, ends)
        seen, begin = [], 0
        for part, own in zip(self._parts, masks, strict=True):
            given = seeds[begin : begin + part.num_worlds]
            starts = part.reset(seed=given, options={RESET_MASK: own})[0] if own.any() else part.worlds.observation()
            seen.append(starts)
            begin += part.num_worlds
        return np.concatenate(seen), {}

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[NDArray[Any], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """One env step of every row; `actions` `[num_envs]`.

        Raises:
          ValueError: an action is none of the action space.
        """
        chunks = np.split(np.asarray(actions), self._ends)
        steps = [part.step(chunk) for part, chunk in zip(self._parts, chunks, strict=True)]
        *columns, infos = zip(*steps, strict=True)
        observation, reward, terminated, truncated = (np.concatenate(column) for column in columns)
        return observation, reward, terminated, truncated, self._joined_infos(steps, infos)

    def _joined_infos(self, steps: list[Any], infos: tuple[dict[str, Any], ...]) -> dict[str, Any]:
        """What the parts tell of decisions and ended episodes; one without any adds rows that its masks leave out."""
        joined: dict[str, Any] = {}
        if any("decided" in info for info in infos):
            everybody = [np.ones(part.num_envs, np.bool_) for part in self._parts]
            decided = [info.get("decided", all_of) for info, all_of in zip(infos, everybody, strict=True)]
            joined["decided"] = np.concatenate(decided)
        ends = [info.get("final_info") for info in infos]
        example = next((end for end in ends if end), None)
        if example is None:
            return joined
        final: Arrays = {}
        for name, column in example.items():
            final[name] = np.concatenate(
                [
                    end[name] if end else np.zeros(part.num_envs, column.dtype)
                    for part, end in zip(self._parts, ends, strict=True)
                ]
            )
        ended = final["_outcome"]
        observations = [info.get("final_obs", step[0]) for step, info in zip(steps, infos, strict=True)]
        return joined | {
            "final_obs": np.concatenate(observations),
            "_final_obs": ended,
            "final_info": final,
            "_final_info": ended,
        }

    def waiting(self) -> NDArray[np.bool_]:
        """As `SwarmVectorEnv.waiting`."""
        return np.concatenate([part.waiting() for part in self._parts])

    def get_state(self) -> Arrays:
        """Copies of all arrays that a checkpoint needs, by part and name."""
        states = [part.get_state() for part in self._parts]
        return {f"{i}.{name}": array for i, state in enumerate(states) for name, array in state.items()}

    def set_state(self, saved: Arrays) -> NDArray[Any]:
        """Takes up saved arrays; returns the observations there.

        Raises:
          ValueError: an array is missing or has another shape or dtype.
        """
        seen = []
        for i, part in enumerate(self._parts):
            own = {name.removeprefix(f"{i}."): array for name, array in saved.items() if name.startswith(f"{i}.")}
            seen.append(part.set_state(own))
        return np.concatenate(seen)
