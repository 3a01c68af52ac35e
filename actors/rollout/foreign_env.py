"""Any Gymnasium environment that is not ours, as a vector environment that checks all that it returns.

This is the one boundary to code that is not ours. Behind it every observation has the shape and dtype of its space,
every observation and reward is a finite number that float32 holds, and every flag is a truth value. Whatever an
environment does instead, and whatever it raises, becomes an EnvError: one sentence with its id, the step and the value.
Infos are the environment's own and stay there.
"""

from __future__ import annotations

import functools
import logging
import math
import traceback
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from actors.rollout.foreign_spaces import Unfit, flat_space, make_encoder, shown
from sim_core.checks import ConfigError
from sim_core.plugins import reason_of

REHEARSAL_STEPS = 20
CANNOT_BE_MADE = "cannot be made by Gymnasium"
OUTSIDE = tuple(str(Path(module).parent) for module in (gym.__file__, np.__file__, __file__))
"""Folders of code that is not the environment's."""


class EnvError(ConfigError):
    """A foreign environment does what it must not; the message names its id, the step and the value.

    Args:
      message: one sentence.
      trace: the traceback of what it raised; empty if it raised nothing.
    """

    def __init__(self, message: str, trace: str = "") -> None:
        super().__init__(message)
        self.trace = trace


class EnvInterrupted(BaseException):
    """Ends a call of an environment that takes too long; user code that catches `Exception` lets it through."""


class CheckedVectorEnv(gym.vector.VectorEnv[NDArray[Any], NDArray[np.int64], NDArray[Any]]):
    """What the two kinds of foreign vector environments have in common: how they check numbers, and tell of errors.

    Args:
      env_id: the id.
      num_envs: how many environments.
      render_mode: of all of them; None draws nothing.

    Attributes:
      envs: the objects whose code is not ours.
      steps: that each environment has made.
    """

    def __init__(self, env_id: str, num_envs: int, render_mode: str | None = None) -> None:
        self.env_id, self.num_envs, self.render_mode = env_id, num_envs, render_mode
        self.steps = 0
        self.envs: list[Any] = []

    def _set_spaces(self, space: gym.spaces.Box, actions: gym.spaces.Discrete) -> None:
        """Sets the spaces of one environment, observations flattened, and of all."""
        self.single_observation_space, self.single_action_space = space, actions
        self.observation_space = batch_space(space, self.num_envs)
        self.action_space = batch_space(actions, self.num_envs)
        self._shape = (self.num_envs, *np.shape(space.low))
        self._is_float = space.dtype.kind == "f"

    def close_extras(self, **kwargs: Any) -> None:
        """Closes every environment; what one does instead is of no use to anybody."""
        for env in self.envs:
            try:
                env.close()
            except KeyboardInterrupt:
                raise
            except BaseException:
                logging.getLogger(__name__).debug("env_id %r cannot be closed", self.env_id, exc_info=True)

    def __del__(self) -> None:
        """Does nothing: an environment's code runs only when it is called."""

    def _raised(self, doing: str, error: BaseException) -> BaseException:
        """The error of a call that raised `error`; that itself, if it is not the environment's."""
        if isinstance(error, (KeyboardInterrupt, ConfigError)):
            return error
        place = _place(error)
        if isinstance(error, EnvInterrupted):
            what = f"{doing}() has not come back{place} within {error}"
        elif isinstance(error, SystemExit):
            what = f"{doing}() ended the process with exit code {error.code}{place}"
        elif doing == "make":
            what = f"it {CANNOT_BE_MADE}: {reason_of(error)}{place}"
        else:
            what = f"{doing}() raised {reason_of(error)}{place}"
        return self._refused(what, error)

    def _check_finite(self, observation: NDArray[Any], reward: NDArray[np.float64] | None = None) -> None:
        """Refuses numbers that are not finite in float32."""
        if reward is not None and not _are_finite(reward):
            raise self._refused(f"step() gave the reward {_first_bad(reward)}, which is not finite in float32")
        if self._is_float and not _are_finite(observation):
            raise self._refused(
                f"it gave an observation with {_first_bad(observation)}, which is not finite in float32"
            )

    def _refused(self, what: str, error: BaseException | None = None) -> EnvError:
        when = f" at its step {self.steps:,}" if self.steps else ""
        return EnvError(f"env_id {self.env_id!r}{when}: {what}", "" if error is None else _trace(error))


class ForeignVectorEnv(CheckedVectorEnv):
    """Environments of one Gymnasium id, one after the other; each restarts in the step that ends its episode.

    Args:
      env_id, num_envs, render_mode: see CheckedVectorEnv.

    Raises:
      EnvError: the id is unknown, the environment cannot be made, or its spaces are none that a run can have.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, env_id: str, num_envs: int, render_mode: str | None = None) -> None:
        super().__init__(env_id, num_envs, render_mode)
        for _ in range(num_envs):
            self.envs.append(self._make())
        (space, actions), *others = map(self._spaces_of, self.envs)
        if not isinstance(actions, gym.spaces.Discrete) or actions.start != 0:
            raise self._refused(f"it must have Discrete actions from 0, not {shown(actions)}")
        try:
            flat = flat_space(space)
        except Unfit as unfit:
            raise self._refused(f"it has {unfit}") from None
        if any(spaces != (space, actions) for spaces in others):
            raise self._refused("it has other spaces each time that it is made")
        self.metadata = self._metadata_of(self.envs[0]) | type(self).metadata
        self._encode = make_encoder(space, flat)
        self._set_spaces(flat, actions)

    def _make(self) -> gym.Env[Any, Any]:
        given: dict[str, Any] = {} if self.render_mode is None else {"render_mode": self.render_mode}
        try:
            return gym.make(self.env_id, disable_env_checker=True, **given)
        except (gym.error.Error, ModuleNotFoundError) as error:  # of a name rather than of the environment's code
            raise EnvError(f"env_id {self.env_id!r} {CANNOT_BE_MADE}: {error}{_place(error)}") from error
        except BaseException as error:
            raise self._raised("make", error) from error

    def _spaces_of(self, env: gym.Env[Any, Any]) -> tuple[Any, Any]:
        try:
            return getattr(env, "observation_space", None), getattr(env, "action_space", None)
        except BaseException as error:
            raise self._raised("observation_space or action_space", error) from error

    def _metadata_of(self, env: gym.Env[Any, Any]) -> dict[str, Any]:
        metadata = getattr(env, "metadata", None)
        return metadata if isinstance(metadata, dict) else {}

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Starts an episode in every environment; environment i takes `seed[i]`.

        Raises:
          EnvError: see the module.
        """
        seeds = seed if isinstance(seed, list) else [seed] * self.num_envs
        observation = self._empty()
        for i, own in enumerate(seeds):
            observation[i] = self._first_observation(i, seed=own, options=options)
        self._check_finite(observation)
        return observation, {}

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[NDArray[Any], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """One step of every environment; `actions` `[num_envs]`.

        Where an episode ends, the observation is the next one's first; its own last is in `infos["final_obs"]`.

        Raises:
          EnvError: see the module.
        """
        self.steps += 1
        observation, reward = self._empty(), np.empty(self.num_envs)
        terminated, truncated = np.empty((2, self.num_envs), np.bool_)
        infos: dict[str, Any] = {}
        for i, (env, action) in enumerate(zip(self.envs, actions, strict=True)):
            try:
                result = env.step(action)
            except BaseException as error:
                raise self._raised("step", error) from error
            if type(result) is not tuple or len(result) != 5 or not isinstance(result[4], dict):
                raise self._refused(_what_step_gave(result))
            row, gain, ended, cut, _ = cast("tuple[Any, ...]", result)
            row = self._encoded("step", row)
            reward[i] = gain if type(gain) is float else self._number(gain)
            terminated[i] = ended = ended if type(ended) is bool else self._flag(ended)
            truncated[i] = cut = cut if type(cut) is bool else self._flag(cut)
            if ended or cut:
                infos.setdefault("final_obs", self._empty())[i] = row
                row = self._first_observation(i)
            observation[i] = row
        self._check_finite(observation, reward)
        if infos:
            infos["_final_obs"] = terminated | truncated
            self._check_finite(infos["final_obs"])
        return observation, reward, terminated, truncated, infos

    def render(self) -> tuple[Any, ...]:
        """What every environment draws, unchecked.

        Raises:
          EnvError: one cannot draw.
        """
        try:
            return tuple(env.render() for env in self.envs)
        except BaseException as error:
            raise self._raised("render", error) from error

    def _empty(self) -> NDArray[Any]:
        return np.zeros(self._shape, self.single_observation_space.dtype)

    def _first_observation(self, i: int, **kwargs: Any) -> NDArray[Any]:
        try:
            result: Any = self.envs[i].reset(**kwargs)
        except BaseException as error:
            raise self._raised("reset", error) from error
        if type(result) is not tuple or len(result) != 2 or not isinstance(result[1], dict):
            raise self._refused(f"reset() gave {shown(result)}, where Gymnasium has (observation, info)")
        return self._encoded("reset", result[0])

    def _encoded(self, doing: str, value: Any) -> NDArray[Any]:
        try:
            return self._encode(value)
        except Unfit as unfit:
            raise self._refused(f"{doing}() gave {unfit}") from None
        except Exception as error:
            what = f"{doing}() gave an observation that is no array: {reason_of(error)}"
            raise self._refused(what, error) from error

    def _number(self, value: Any) -> float:
        if type(value) is float:
            return value
        array = _as_array(value)
        if array is None or array.dtype.kind not in "biuf":
            raise self._refused(f"step() gave the reward {shown(value)}, which is no number")
        return float(array)

    def _flag(self, value: Any) -> bool:
        if type(value) is bool:
            return value
        array = _as_array(value)
        if array is None or array.dtype.kind not in "biu" or array not in (0, 1):
            raise self._refused(f"step() gave {shown(value)} where terminated and truncated must be True or False")
        return bool(array)


def _what_step_gave(result: Any) -> str:
    if isinstance(result, tuple) and len(result) == 5:
        return f"step() gave the info {shown(result[4])}, which is no dict"
    what = f"{len(result)} values" if isinstance(result, tuple) else shown(result)
    return f"step() gave {what}, where Gymnasium has (observation, reward, terminated, truncated, info)"


def _trace(error: BaseException) -> str:
    return "".join(traceback.format_exception(error))


def _as_array(value: Any) -> NDArray[Any] | None:
    """The one number that `value` is or holds, as an array without dimension; None if it is none."""
    try:
        array = np.asarray(value)
        return array.reshape(()) if array.size == 1 else None
    except Exception:  # whatever the value's own conversion raises
        return None


def _are_finite(values: NDArray[Any]) -> bool:
    """Whether float32 holds all values: by the sum of their squares, and one by one only where that is large."""
    flat = values.reshape(-1)
    with np.errstate(over="ignore", invalid="ignore"):
        return math.isfinite(np.dot(flat, flat).astype(np.float32)) or bool(_held(flat).all())


def _held(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Which values are finite in float32."""
    with np.errstate(over="ignore"):
        return np.isfinite(values.astype(np.float32))


def _first_bad(values: NDArray[Any]) -> float:
    return float(values[~_held(values)][0])


def _place(error: BaseException) -> str:
    """Where in the environment's code an error comes from, such as ` (my_env.py, line 12)`."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith(OUTSIDE)]
    return f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""


@functools.lru_cache(maxsize=64)
def rehearse_env(env_id: str) -> tuple[gym.spaces.Box, gym.spaces.Discrete]:
    """Plays a few steps of an environment, so that what is wrong with it shows before anything else starts.

    Returns:
      Its spaces of observations, flattened, and of actions.

    Raises:
      EnvError: see the module.
    """
    env, rng = ForeignVectorEnv(env_id, 1), np.random.default_rng(0)
    observations, actions = env.single_observation_space, env.single_action_space
    assert isinstance(observations, gym.spaces.Box) and isinstance(actions, gym.spaces.Discrete)
    try:
        env.reset(seed=[0])
        for _ in range(REHEARSAL_STEPS):
            env.step(rng.integers(actions.n, size=1))
        env.reset()
    finally:
        env.close()
    return observations, actions
