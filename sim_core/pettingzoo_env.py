"""The learning robots of one world as agents of a PettingZoo `ParallelEnv`; see `sim_core.parallel_env`."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from sim_core.envs import check_render_mode, draw, frames_per_s, make_config, observation_space
from sim_core.outcomes import Outcome
from sim_core.reset_arguments import whole_seed
from sim_core.worlds import WorldBatch, is_done, is_terminated


class SwarmParallelEnv(ParallelEnv[str, NDArray[Any], int]):
    """One world; an agent is a learning robot, `robot_k` the k-th by its index, so robot k where all robots learn.

    An agent leaves `agents` with the step that ends its episode: terminated by its outcome, or truncated by the
    horizon. `infos[agent]` holds its `outcome` (an `Outcome`) and `robot`, its index in the world; at its end also
    `episode_length` (simulator steps) and `episode_return`.

    Args:
      render_mode: None or `rgb_array`.
      settings: fields of WorldConfig.

    Raises:
      ConfigError: a setting is unknown or cannot work.
    """

    metadata: dict[str, Any] = {"name": "shoal_segregated_swarm_v0", "render_modes": ["rgb_array"]}

    def __init__(self, render_mode: str | None, settings: dict[str, Any]) -> None:
        check_render_mode(render_mode)
        self.config = make_config(settings)
        self.render_mode = render_mode
        self.metadata = type(self).metadata | {"render_fps": frames_per_s(self.config)}
        self.possible_agents = [f"robot_{row}" for row in range(self.config.num_learners)]
        self.agents: list[str] = []
        observation, action = observation_space(self.config), gym.spaces.Discrete(self.config.num_actions)
        self.observation_spaces: dict[str, gym.Space[Any]] = dict.fromkeys(self.possible_agents, observation)
        self.action_spaces: dict[str, gym.Space[Any]] = dict.fromkeys(self.possible_agents, action)
        self.worlds = WorldBatch(self.config, 1)
        self._row = {agent: row for row, agent in enumerate(self.possible_agents)}
        self._seeded = False

    def observation_space(self, agent: str) -> gym.Space[Any]:
        """What an agent sees; alike for all."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gym.Space[Any]:
        """What an agent does; alike for all."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, dict[str, Any]]]:
        """Starts an episode of every agent; with `seed`, from that seed's random stream.

        `options` are ignored, since PettingZoo's users may give any. Without a seed the world goes on with its random
        stream; at its first reset that is drawn at random.

        Raises:
          ValueError: the seed is negative or no whole number.
        """
        if seed is not None or not self._seeded:
            drawn = int(np.random.SeedSequence().generate_state(1)[0])
            self.worlds.seed([drawn if seed is None else whole_seed(seed)])
            self._seeded = True
        observation = self.worlds.reset()
        self.agents = list(self.possible_agents)
        return dict(zip(self.agents, observation, strict=True)), {agent: self._info(agent) for agent in self.agents}

    def step(
        self, actions: dict[str, int]
    ) -> tuple[dict[str, NDArray[Any]], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """One env step: each of the present `agents` takes its action.

        Raises:
          ValueError: there are not actions of just the present agents, or one is none of the action space.
        """
        if set(actions) != set(self.agents):
            raise ValueError(f"actions must be those of {self.agents}, not of {sorted(actions)}")
        if not self.agents:
            return {}, {}, {}, {}, {}
        action = np.zeros(len(self.possible_agents), np.int64)
        for agent, chosen in actions.items():
            if not self.action_spaces[agent].contains(chosen):
                raise ValueError(f"action of {agent} must be in 0..{self.config.num_actions - 1}, not {chosen!r}")
            action[self._row[agent]] = chosen
        result, present = self.worlds.step(action), self.agents
        done = is_done(result.outcome)
        terminated = is_terminated(result.outcome, self.config.timeout_fails)
        rows = {agent: self._row[agent] for agent in present}
        infos = {agent: self._info(agent) for agent in present}
        for agent, row in rows.items():
            if done[row]:
                infos[agent]["episode_length"] = int(result.steps[row])
                infos[agent]["episode_return"] = float(result.episode_return[row])
        self.agents = [agent for agent, row in rows.items() if not done[row]]
        return (
            {agent: result.observation[row] for agent, row in rows.items()},
            {agent: float(result.reward[row]) for agent, row in rows.items()},
            {agent: bool(terminated[row]) for agent, row in rows.items()},
            {agent: bool(done[row] and not terminated[row]) for agent, row in rows.items()},
            infos,
        )

    def _info(self, agent: str) -> dict[str, Any]:
        row = self._row[agent]
        return {"outcome": Outcome(self.worlds.outcome[row]), "robot": int(self.worlds.state.learner[row])}

    def state(self) -> NDArray[np.float32]:
        """The world `[4 * num_robots + 2 * groups]`: x, y, vx, vy of all robots, x and y of the goals (metres, m/s)."""
        state = self.worlds.state
        names = ("pos_x", "pos_y", "vel_x", "vel_y", "goal_x", "goal_y")
        return np.concatenate([getattr(state, name)[0] for name in names]).astype(np.float32)

    def render(self) -> NDArray[np.uint8] | None:
        """The world as `[height, width, 3]` uint8 in mode `rgb_array`, else None."""
        return draw(self.worlds, 0) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Does nothing: there is nothing to free."""
