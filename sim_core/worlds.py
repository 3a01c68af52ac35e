"""A batch of worlds with its method: reset, step, perceive; the plain class under the environments."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_core.config import WorldConfig
from sim_core.jit import kernel
from sim_core.methods import make_method
from sim_core.outcomes import Outcome
from sim_core.packed import packed
from sim_core.pilot import Pilot
from sim_core.rng import world_streams
from sim_core.scenes import make_scene
from sim_core.senses import Senses
from sim_core.shield import Shield
from sim_core.state import CONSTANT, WorldState, empty_state
from sim_core.swarm.step import advance, reset_episode, swarm_params
from sim_core.swarm.tile import world_tile

_RUNNING = int(Outcome.RUNNING)
FAR_M = 1e3
"""Where FL-ORCA in the learning robot's place puts robots that it does not sense: far from all others."""


@kernel
def _end_step(running: Any, outcome: Any, step_reward: Any, reward: Any) -> Any:
    """Adds the rewards of the worlds that were running, and stops those that have ended; whether any still runs."""
    any_running = False
    for world in range(running.shape[0]):
        if running[world]:
            reward[world] += step_reward[world]
            running[world] = outcome[world] == _RUNNING
            any_running |= running[world]
    return any_running


class Command(NamedTuple):
    """Velocities for the learning robots that are given from outside: by a person, or any other controller.

    They take the place of an action's; shield and errors of driving apply as to those.
    """

    velocity: NDArray[np.float32]
    """`[2, num_worlds]`, m/s."""


Decision = NDArray[np.int64] | Pilot | Command
"""Actions `[num_worlds]`, how FL-ORCA drives the learning robot too, or given velocities."""


class StepResult(NamedTuple):
    """What a decision leads to, one entry a world.

    `observation` is the state after it, also where the episode ended; `reward` the sum over its simulator steps;
    `steps` the simulator steps of the episode so far. Shapes `[num_worlds, ...]`; reward float32, outcome int8 (see
    Outcome), steps int32, episode_return float64.
    """

    observation: NDArray[Any]
    reward: NDArray[np.float32]
    outcome: NDArray[np.int8]
    steps: NDArray[np.int32]
    episode_return: NDArray[np.float64]


class WorldBatch:
    """Worlds of one setup that step together; no world influences another.

    Args:
      config: the setup.
      num_worlds: size of the batch.

    Attributes:
      state: the worlds as they are.
      sensed: the worlds as the learning robots sense them; `state` itself unless the settings impair senses.
      step_reward: `[num_worlds]` float32, reward of the last simulator step.
      asked: `[2, num_worlds]` float32, m/s: the velocity of the last step before shield and errors of driving.
    """

    def __init__(self, config: WorldConfig, num_worlds: int) -> None:
        self.config = config
        self.num_worlds = num_worlds
        self.method = make_method(config)
        self.state: WorldState = empty_state(config, num_worlds, np.float32)
        self.tile = world_tile(config, num_worlds, np.float32)
        self.swarm = packed(swarm_params(config, np.float32))
        self.scene = make_scene(config)
        impaired = config.senses_badly or config.drives_badly
        self._senses = Senses(config, self.state) if impaired else None
        self._shield = Shield(config) if config.shield == "orca" else None
        self.sensed: WorldState = self.state if self._senses is None else self._senses.sensed
        self.asked = np.zeros((2, num_worlds), np.float32)
        self._command = np.zeros((2, num_worlds), np.float32)
        self._command_x, self._command_y = self._command
        self._observation = np.zeros((num_worlds, *self.method.observation_shape), self.method.observation_dtype)
        self._history = np.zeros((num_worlds, config.history, *self.method.observation_shape), self._observation.dtype)
        self._reward = np.zeros(num_worlds, np.float32)
        self.step_reward = np.zeros(num_worlds, np.float32)
        self._running = np.zeros(num_worlds, np.bool_)
        self._outcome = np.zeros(num_worlds, np.int8)
        self._all = np.ones(num_worlds, np.bool_)
        self.seed(list(range(num_worlds)))

    def seed(self, seeds: Sequence[int | None]) -> None:
        """Gives world i the random stream of `seeds[i]`; None leaves it as it is. At first it is that of seed i.

        Raises:
          ValueError: there is not one seed a world.
        """
        if len(seeds) != self.num_worlds:
            raise ValueError(f"seeds must be {self.num_worlds}, one a world, not {len(seeds)}")
        for world, seed in enumerate(seeds):
            if seed is not None:
                self.state.rng[world] = world_streams(seed, 1)[0]

    def reset(self, mask: NDArray[np.bool_] | None = None) -> NDArray[Any]:
        """Starts new episodes where `mask` `[num_worlds]` is set (everywhere by default).

        Returns:
          Observations of all worlds, a copy.
        """
        mask = self._all if mask is None else mask
        self.scene.start(self.state, mask)
        reset_episode(self.state, mask)
        if self._senses is not None:
            self._senses.begin(mask)
        self.method.perceive(self.sensed, mask, self._observation)
        if self.config.history > 1:
            self._history[mask] = self._observation[mask, None]
        return self.observation()

    def observation(self) -> NDArray[Any]:
        """What the policy sees `[num_worlds, size]`, a copy: with a history, the newest observation first.

        Where an observation is rows of groups, the row of a group holds its elements of all these observations.
        """
        if self.config.history == 1:
            return self._observation.copy()
        frames, rows = self._history, self.method.row_size
        if rows:
            frames = frames.reshape(self.num_worlds, self.config.history, -1, rows).swapaxes(1, 2)
        return frames.reshape(self.num_worlds, -1).copy()

    def step(self, action: Decision, watch: Callable[[], None] | None = None) -> StepResult:
        """Takes one decision in every world: `decision_interval_steps` simulator steps with the same action.

        A world whose episode ends within the interval stays as it ended. Ended worlds are not restarted.

        Args:
          action: what the learning robots do.
          watch: called after each simulator step.

        Returns:
          StepResult of copies.

        Raises:
          ValueError: there is not one action or velocity a world, or one is none of the actions.
        """
        if action is Pilot.SNAPPED:
            action = self.actions_nearest_to_swarm()
        if isinstance(action, Command) and action.velocity.shape != self._command.shape:
            raise ValueError(f"velocities must be {self._command.shape}, not {action.velocity.shape}")
        self._running.fill(True)
        self._reward.fill(0.0)
        for left in range(self.config.decision_interval_steps - 1, -1, -1):
            any_running = self._simulate(action)
            if watch is not None:
                watch()
            if left and not any_running:
                break
        self._perceive()
        return StepResult(
            self.observation(),
            self._reward.copy(),
            self._outcome.copy(),
            self.state.steps.copy(),
            self.state.episode_return.copy(),
        )

    def _perceive(self) -> None:
        self.method.perceive(self.sensed, self._all, self._observation)
        if self.config.history > 1:
            self._history[:, 1:] = self._history[:, :-1].copy()
            self._history[:, 0] = self._observation

    def _simulate(self, action: Decision) -> bool:
        """Moves the running worlds by one simulator step and adds its rewards; returns whether any still runs."""
        state, running = self.state, self._running
        is_given = self._give_command(action)
        advance(state, self.tile, running, self._command_x, self._command_y, is_given, self.swarm)
        self.method.outcome(state, running, self._outcome)
        self.method.reward(state, running, self._outcome, self.step_reward)
        if self._senses is not None:
            self._senses.sense(running)
        return bool(_end_step(running, self._outcome, self.step_reward, self._reward))

    def _give_command(self, action: Decision) -> bool:
        """Writes the velocities that the learning robots drive; returns False where FL-ORCA drives as it is."""
        command, as_asked = self._command, self._senses is None and self._shield is None
        if isinstance(action, Pilot):
            if as_asked:
                return False
            command[:] = self._swarm_velocity()
        elif isinstance(action, Command):
            command[:] = action.velocity
        else:
            self.method.velocity(self.sensed, action, self._command_x, self._command_y)
        if as_asked:
            return True
        self.asked[:] = command
        if self._shield is not None:
            self._shield.project(self.sensed, self._running, self._command_x, self._command_y)
        if self._senses is not None:
            self._senses.drive(self._running, self._command_x, self._command_y)
        return True

    def _swarm_velocity(self) -> NDArray[np.float32]:
        """The velocities `[2, num_worlds]` (m/s) that FL-ORCA has for the learning robots by what they sense."""
        state = WorldState(*(array.copy() for array in self.sensed))
        world, unknown = np.arange(self.num_worlds), np.isnan(state.pos_x)
        for position in (state.pos_x, state.pos_y):
            np.copyto(position, position[world, state.learner][:, None] + np.float32(FAR_M), where=unknown)
        state.vel_x[unknown] = state.vel_y[unknown] = 0.0
        advance(state, self.tile, self._all, self._command_x, self._command_y, False, self.swarm)
        return np.stack([state.vel_x[world, state.learner], state.vel_y[world, state.learner]])

    def actions_nearest_to_swarm(self) -> NDArray[np.int64]:
        """The actions `[num_worlds]` whose velocities are nearest to those that FL-ORCA has for the learning robots."""
        wanted = self._swarm_velocity()
        distance_sq = np.empty((self.config.num_actions, self.num_worlds))
        velocity = np.empty((2, self.num_worlds), np.float32)
        for action in range(self.config.num_actions):
            self.method.velocity(self.sensed, np.full(self.num_worlds, action), velocity[0], velocity[1])
            distance_sq[action] = np.square(velocity - wanted).sum(axis=0)
        return np.asarray(distance_sq.argmin(axis=0), np.int64)

    def swarm_step(self) -> None:
        """Moves every world by one simulator step, the learning robot too, and nothing else: no outcome, no reward."""
        advance(self.state, self.tile, self._all, self._command_x, self._command_y, False, self.swarm)

    def positions(self) -> NDArray[np.float32]:
        """Positions `[num_worlds, num_robots, 2]`, metres."""
        return np.stack([self.state.pos_x, self.state.pos_y], axis=-1)

    def sensed_positions(self) -> NDArray[np.float32]:
        """Positions as the learning robots sense them `[num_worlds, num_robots, 2]`, metres; NaN where not."""
        return np.stack([self.sensed.pos_x, self.sensed.pos_y], axis=-1)

    def goals(self) -> NDArray[np.float32]:
        """Goals `[num_worlds, groups, 2]`, metres."""
        return np.stack([self.state.goal_x, self.state.goal_y], axis=-1)

    def _changing(self) -> dict[str, NDArray[Any]]:
        """The arrays that steps change."""
        changing = {name: array for name, array in self.state._asdict().items() if name not in CONSTANT}
        changing |= {} if self._senses is None else self._senses.arrays()
        return changing | ({"history": self._history} if self.config.history > 1 else {})

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Copies of all arrays that a checkpoint needs, by name."""
        return {name: array.copy() for name, array in self._changing().items()}

    def set_state(self, saved: dict[str, NDArray[Any]]) -> NDArray[Any]:
        """Takes up saved arrays; returns the observations there.

        Raises:
          ValueError: an array is missing or has another shape or dtype; nothing is taken up.
        """
        arrays = self._changing()
        for name, array in arrays.items():
            new = saved.get(name)
            if new is None or new.shape != array.shape or new.dtype != array.dtype:
                raise ValueError(f"saved worlds do not fit: {name} should be {array.dtype}{array.shape}")
        for name, array in arrays.items():
            array[...] = saved[name]
        self.method.perceive(self.sensed, self._all, self._observation)
        return self.observation()


REHEARSAL_WORLDS, REHEARSAL_STEPS = 16, 20


@functools.lru_cache(maxsize=64)
def rehearse(config: WorldConfig) -> None:
    """Plays a little in a world with a user's own method or scene, so that what is wrong with it shows at once.

    Raises:
      PluginError: the user's code raises, or gives what it must not give; the message names its file and line.
    """
    if not config.sources:
        return
    worlds = WorldBatch(config, REHEARSAL_WORLDS)
    worlds.reset()
    rng = np.random.default_rng(0)
    for _ in range(REHEARSAL_STEPS):
        done = is_done(worlds.step(rng.integers(config.num_actions, size=REHEARSAL_WORLDS)).outcome)
        if done.any():
            worlds.reset(done)


def is_done(outcome: NDArray[np.int8]) -> NDArray[np.bool_]:
    """Where an episode has ended."""
    return np.not_equal(outcome, int(Outcome.RUNNING))


def is_terminated(outcome: NDArray[np.int8], timeout_fails: bool) -> NDArray[np.bool_]:
    """Where an episode has reached a terminal state; a timeout is one if it counts as a failure of the task."""
    return is_done(outcome) & (np.not_equal(outcome, int(Outcome.TIMEOUT)) | timeout_fails)
