"""Gymnasium environments over the worlds: one world as `Env`, a whole batch as `VectorEnv`.

Registered as `shoal/SegregatedSwarm-v0`; keyword arguments are the fields of `WorldConfig`:

    import gymnasium as gym
    import sim_core
    env = gym.make("shoal/SegregatedSwarm-v0", robots=10, groups=2)
    envs = gym.make_vec("shoal/SegregatedSwarm-v0", num_envs=64, robots=10, groups=2)

Observations, actions, rewards and outcomes are those of the chosen method. A success or failure of the
task terminates an episode; the horizon truncates it, unless a timeout is a failure (`horizon_is`). The vector
environment restarts ended worlds in the same step (`AutoresetMode.SAME_STEP`): the returned observation is the new
episode's first, the ended one's last stands in `infos["final_obs"]`, and `infos["final_info"]` holds `outcome`,
`episode_length` and `episode_return`; the masks `_final_obs` and `_final_info` say where. `autoreset_mode` selects
Gymnasium's other modes, which its wrappers of observations need: with `NEXT_STEP` a world restarts in the step after
the one that ended it, with `DISABLED` only by `reset` with a mask. Then the same values stand in `infos` itself.
"""

from __future__ import annotations

from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from sim_core.checks import ConfigError, require
from sim_core.config import WorldConfig
from sim_core.methods import make_method
from sim_core.outcomes import Outcome
from sim_core.render import draw_world
from sim_core.reset_arguments import RESET_MASK, check_options, env_seeds, reset_mask, whole_seed
from sim_core.worlds import StepResult, WorldBatch, is_done, is_terminated

RENDER_MODES = ["rgb_array"]


def make_config(settings: dict[str, Any]) -> WorldConfig:
    """WorldConfig from keyword arguments.

    Raises:
      ConfigError: a key is unknown or a value cannot work.
    """
    unknown = sorted(set(settings) - set(WorldConfig.__dataclass_fields__))
    if unknown:
        raise ConfigError(f"unknown setting {unknown[0]!r}; the settings are the fields of WorldConfig")
    return WorldConfig(**settings)


def observation_space(config: WorldConfig) -> gym.spaces.Box:
    """What the policy sees of one world: the method's observations, of the last `history` decisions."""
    method = make_method(config)
    limit, (size,) = method.observation_limit, method.observation_shape
    return gym.spaces.Box(-limit, limit, (size * config.history,), method.observation_dtype)


def check_render_mode(render_mode: str | None) -> None:
    """Raises ConfigError if an environment cannot draw in this mode."""
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise ConfigError(f"render_mode must be one of {RENDER_MODES} or None, not {render_mode!r}")


def frames_per_s(config: WorldConfig) -> int:
    """Decisions a second, which are the images a second of a drawing in true time."""
    return max(1, round(1 / config.decision_s))


def draw(worlds: WorldBatch, world: int) -> NDArray[np.uint8]:
    """A world as `[height, width, 3]` uint8."""
    learners = worlds.state.learner.reshape(worlds.num_worlds, -1)[world]
    return draw_world(worlds.positions()[world], worlds.goals()[world], learners, worlds.config)


class SwarmEnv(gym.Env[NDArray[Any], np.int64]):
    """One world; `info["outcome"]` is an `Outcome`, `Outcome.RUNNING` until the episode ends.

    Args:
      render_mode: None or `rgb_array`.
      **settings: fields of WorldConfig.

    Raises:
      ConfigError: a setting is unknown or cannot work.
    """

    metadata: dict[str, Any] = {"render_modes": RENDER_MODES}  # gym.make asks the class

    def __init__(self, render_mode: str | None = None, **settings: Any) -> None:
        check_render_mode(render_mode)
        self.config = make_config(settings)
        require(
            self.config.num_learners == 1,
            f"learners must be one in an environment of one agent, not {self.config.learners}: several are rows of "
            "gymnasium.make_vec, or agents of sim_core.parallel_env",
        )
        self.metadata = {"render_modes": RENDER_MODES, "render_fps": frames_per_s(self.config)}
        self.render_mode = render_mode
        self.observation_space = observation_space(self.config)
        self.action_space = cast("gym.Space[np.int64]", gym.spaces.Discrete(self.config.num_actions))
        self.worlds = WorldBatch(self.config, 1)
        self._seeded = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Starts an episode; with `seed`, from that seed's random stream. There are no `options`.

        Raises:
          ValueError: the seed is negative or no whole number, or there is an option.
        """
        check_options(options, ())
        seed = None if seed is None else whole_seed(seed)
        super().reset(seed=seed)
        if seed is None and not self._seeded:
            seed = int(self.np_random.integers(2**31))
        if seed is not None:
            self.worlds.seed([seed])
            self._seeded = True
        return self.worlds.reset()[0], {"outcome": int(Outcome.RUNNING)}

    def step(self, action: np.int64) -> tuple[NDArray[Any], float, bool, bool, dict[str, Any]]:
        """One env step; see the module for what ends an episode.

        Raises:
          ValueError: the action is none of the action space.
        """
        if not self.action_space.contains(action):
            raise ValueError(f"action must be in 0..{self.config.num_actions - 1}, not {action!r}")
        result = self.worlds.step(np.array([action], np.int64))
        outcome = int(result.outcome[0])
        info: dict[str, Any] = {"outcome": outcome}
        if outcome != Outcome.RUNNING:
            info["episode_length"] = int(result.steps[0])
            info["episode_return"] = float(result.episode_return[0])
        terminated = bool(is_terminated(result.outcome, self.config.timeout_fails)[0])
        truncated = outcome == Outcome.TIMEOUT and not terminated
        return result.observation[0], float(result.reward[0]), terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """The world as `[height, width, 3]` uint8 in mode `rgb_array`, else None."""
        return draw(self.worlds, 0) if self.render_mode == "rgb_array" else None


class SwarmVectorEnv(gym.vector.VectorEnv[NDArray[Any], NDArray[np.int64], NDArray[Any]]):
    """A batch of worlds stepped by one call.

    Args:
      num_envs: number of rows: of worlds, or of learning robots where several of a world learn.
      render_mode: None or `rgb_array`.
      autoreset_mode: when ended worlds restart (see the module).
      **settings: fields of WorldConfig.

    Raises:
      ConfigError: a setting is unknown or cannot work.
    """

    metadata: dict[str, Any] = {"render_modes": RENDER_MODES, "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode = AutoresetMode.SAME_STEP,
        **settings: Any,
    ) -> None:
        check_render_mode(render_mode)
        modes = list(AutoresetMode)
        require(autoreset_mode in modes, f"autoreset_mode must be one of {modes}, not {autoreset_mode!r}")
        is_count = isinstance(num_envs, int | np.integer) and num_envs >= 1
        require(is_count, f"num_envs must be a whole number of at least 1, not {num_envs!r}")
        self.config = make_config(settings)
        per_world = self.config.num_learners
        require(
            num_envs % per_world == 0,
            f"num_envs must be a multiple of {per_world}, the learning robots of a world (learners = "
            f"{self.config.learners}), not {num_envs}",
        )
        require(
            per_world == 1 or autoreset_mode is AutoresetMode.SAME_STEP,
            f"autoreset_mode must be SAME_STEP where several robots of a world learn, not {autoreset_mode.name}",
        )
        self.metadata = {
            "autoreset_mode": autoreset_mode,
            "render_modes": RENDER_MODES,
            "render_fps": frames_per_s(self.config),
        }
        self.render_mode = render_mode
        self.num_envs = int(num_envs)
        self.num_worlds = self.num_envs // per_world
        self._several, self._num_actions = per_world > 1, self.config.num_actions
        self._timeout_fails = self.config.timeout_fails
        self.single_observation_space = observation_space(self.config)
        self.single_action_space = gym.spaces.Discrete(self.config.num_actions)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.worlds = WorldBatch(self.config, self.num_worlds)
        self._begun = False
        self._mode = autoreset_mode
        self._ended = np.zeros(self.num_worlds, np.bool_)  # worlds that are to restart

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Starts episodes in every world, or where `options["reset_mask"]` `[num_worlds]` bool is True.

        World i takes `seed + i`, or `seed[i]` of a list. Without a seed it goes on with its random stream; at its
        first reset that is drawn at random.

        Raises:
          ValueError: see `env_seeds` and `reset_mask`; or the mask leaves out a world that has not begun.
        """
        mask, seeds = reset_mask(options, self.num_worlds), env_seeds(seed, self.num_worlds)
        if not self._begun:
            if mask is not None and not mask.all():
                raise ValueError(f"the first reset must start every world; leave {RESET_MASK} out")
            drawn = np.random.SeedSequence().generate_state(self.num_worlds)
            seeds = [int(drawn[world]) if own is None else own for world, own in enumerate(seeds)]
            self._begun = True
        if mask is not None:
            seeds = [own if restarts else None for own, restarts in zip(seeds, mask, strict=True)]
        self.worlds.seed(seeds)
        self._ended[... if mask is None else mask] = False
        return self.worlds.reset(mask), {}

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[NDArray[Any], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """One env step of every row; `actions` `[num_envs]`. A world that restarts in it takes no action.

        Raises:
          ValueError: an action is none of the action space, or a world has ended and is not to restart by itself.
        """
        actions = np.asarray(actions)
        whole = actions.shape == (self.num_envs,) and actions.dtype.kind in "iu"
        if not whole or actions.astype(np.uint64, copy=False).max() >= self._num_actions:  # a negative one is large
            raise ValueError(f"actions must be {self.num_envs} whole numbers in 0..{self._num_actions - 1}")
        if self._mode is AutoresetMode.DISABLED and self._ended.any():
            raise ValueError(f"worlds {np.flatnonzero(self._ended).tolist()} have ended; reset them with {RESET_MASK}")
        restarted = self._ended
        streams = None if self._mode is AutoresetMode.SAME_STEP else self.worlds.state.rng.copy()
        result = self.worlds.step(actions.astype(np.int64, copy=False))
        if self._several:
            return self._step_of_robots(result)
        done = is_done(result.outcome)
        if streams is not None:
            done &= ~restarted
        terminated = is_terminated(result.outcome, self._timeout_fails) & done
        observation, reward = result.observation, result.reward.astype(np.float64)
        any_done = np.count_nonzero(done)  # which takes a fifth of `done.any()`
        infos = _ends(result, done) if any_done else {}
        if streams is None:
            if any_done:
                infos = {"final_obs": observation, "_final_obs": done, "final_info": infos, "_final_info": done}
                observation = self.worlds.reset(done)
            return observation, reward, terminated, done & ~terminated, infos
        if restarted.any():  # they start as if they had not been stepped
            self.worlds.state.rng[restarted] = streams[restarted]
            observation, reward[restarted] = self.worlds.reset(restarted), 0.0
        self._ended = done
        return observation, reward, terminated, done & ~terminated, infos

    def waiting(self) -> NDArray[np.bool_]:
        """Where a robot's episode has ended and its world has not `[num_envs]`: its next action is not taken."""
        return is_done(self.worlds.outcome) if self._several else np.zeros(self.num_envs, np.bool_)

    def _step_of_robots(
        self, result: StepResult
    ) -> tuple[NDArray[Any], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """What `step` returns where several robots of a world learn; restarts the worlds that have ended."""
        done = is_done(result.outcome) & result.decided
        terminated = is_terminated(result.outcome, self._timeout_fails) & done
        observation, infos = result.observation, {"decided": result.decided}
        if np.count_nonzero(done):
            infos |= {"final_obs": observation, "_final_obs": done}
            infos |= {"final_info": _ends(result, done), "_final_info": done}  # type: ignore[dict-item]
            ended = self.worlds.ended_worlds()
            if np.count_nonzero(ended):
                observation = self.worlds.reset(ended)
        return observation, result.reward.astype(np.float64), terminated, done & ~terminated, infos

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Copies of all arrays that a checkpoint needs, by name."""
        waiting = {} if self._mode is AutoresetMode.SAME_STEP else {"ended": self._ended.copy()}
        return self.worlds.get_state() | waiting

    def set_state(self, saved: dict[str, NDArray[Any]]) -> NDArray[Any]:
        """Takes up saved arrays; returns the observations there (see `WorldBatch.set_state` for errors)."""
        observation = self.worlds.set_state(saved)
        self._begun = True
        self._ended = saved.get("ended", np.zeros(self.num_worlds, np.bool_)).copy()
        return observation

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """One image `[height, width, 3]` uint8 a world in mode `rgb_array`, else None."""
        if self.render_mode != "rgb_array":
            return None
        return tuple(draw(self.worlds, world) for world in range(self.num_worlds))


def _ends(result: StepResult, done: NDArray[np.bool_]) -> dict[str, Any]:
    """What is told of the episodes that ended in a step, with the masks that say where."""
    values = {"outcome": result.outcome, "episode_length": result.steps, "episode_return": result.episode_return}
    return values | {f"_{name}": done for name in values}
