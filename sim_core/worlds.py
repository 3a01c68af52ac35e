"""A batch of worlds with its method: reset, step, perceive; the plain class under the environments."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_core.config import WorldConfig
from sim_core.jit import StateKernel
from sim_core.methods import make_method
from sim_core.outcomes import Outcome
from sim_core.packed import packed
from sim_core.pilot import Pilot
from sim_core.plugins import METHODS
from sim_core.rng import world_streams
from sim_core.rows import RowView, begin_decision, counts_of, draw_learners, end_step, leave_worlds
from sim_core.scenes import make_scene
from sim_core.senses import Senses
from sim_core.shield import Shield
from sim_core.state import CONSTANT, WorldState, empty_state
from sim_core.swarm.step import advance, reset_episode, swarm_params
from sim_core.swarm.tile import world_tile
from sim_core.team import mark_learner_collisions, segregated_fraction
from sim_core.unicycle import Unicycle

FAR_M = 1e3
"""Where FL-ORCA in the learning robot's place puts robots that it does not sense: far from all others."""


class Command(NamedTuple):
    """Velocities for the learning robots that are given from outside: by a person, or any other controller.

    They take the place of an action's; shield, errors of driving and a unicycle's limits apply as to those.
    """

    velocity: NDArray[np.float32]
    """`[2, num_rows]`, m/s."""


Decision = NDArray[np.int64] | Pilot | Command
"""Actions `[num_rows]`, how FL-ORCA drives the learning robots too, or given velocities."""


class StepResult(NamedTuple):
    """What a decision leads to, one entry a learning robot (a row), world after world.

    `observation` is the state after it, or where the episode ended in it, as it ended; `reward` the sum over its
    simulator steps; `steps` the simulator steps of the episode so far; `decided` whether the robot took the decision,
    which it did not if its episode had ended before. What is told of such a robot is what was told when it ended, with
    a reward of 0. Shapes `[num_rows, ...]`; reward float32, outcome int8 (see Outcome), steps int32, episode_return
    float64, decided bool.
    """

    observation: NDArray[Any]
    reward: NDArray[np.float32]
    outcome: NDArray[np.int8]
    steps: NDArray[np.int32]
    episode_return: NDArray[np.float64]
    decided: NDArray[np.bool_]


class WorldBatch:
    """Worlds of one setup that step together; no world influences another.

    Each learning robot has an episode of its own, which ends with its outcome; until its world restarts it is then a
    robot of the swarm (`ended_learners`). A world has ended once all of its learning robots' episodes have, which the
    horizon ends at the latest. `num_rows` counts learning robots, world after world.

    Args:
      config: the setup.
      num_worlds: size of the batch.

    Attributes:
      num_rows: learning robots of all worlds.
      state: the worlds as they are.
      sensed: the worlds as the learning robots sense them; `state` itself unless the settings impair senses. With
        several learning robots a world, `sensed` may hold a world for each row (`sim_core.rows.RowView`).
      outcome: `[num_rows]` int8, how the episodes ended; RUNNING while they go on.
      step_reward: `[num_rows]` float32, reward of the last simulator step.
      asked: `[2, num_rows]` float32, m/s: the velocity of the last step before shield, errors of driving, unicycle.
      hit_learner: `[num_rows]` bool, whether an episode ended in a collision with another running learning robot.
    """

    def __init__(self, config: WorldConfig, num_worlds: int) -> None:
        self.config = config
        self.num_worlds = num_worlds
        self._per_world = config.num_learners
        self.num_rows = num_rows = num_worlds * self._per_world
        self.method = make_method(config)
        self._advance, self._end_step, self._reset_episode = map(StateKernel, (advance, end_step, reset_episode))
        self._draw_learners, self._leave_worlds = StateKernel(draw_learners), StateKernel(leave_worlds)
        self._mark_learner_collisions = StateKernel(mark_learner_collisions)
        self.state: WorldState = empty_state(config, num_worlds, np.float32)
        self.tile = world_tile(config, num_worlds, np.float32)
        self.swarm = packed(swarm_params(config, np.float32))
        self.scene = make_scene(config)
        self._counts = counts_of(config)
        self._several = self._per_world > 1
        scene_learner = np.zeros(num_worlds, np.int32) if self._several else self.state.learner
        self._scene_state = self.state._replace(learner=scene_learner)
        impaired, shielded = config.senses_badly or config.drives_badly, config.shield == "orca"
        is_unicycle = config.kinematics == "unicycle"
        wants_rows = self._several and (impaired or shielded or bool(config.source(METHODS)))
        self._view = RowView(self.state) if wants_rows else None
        self._known: WorldState = self.state if self._view is None else self._view.state
        self._senses = Senses(config, self._known) if impaired else None
        self._shield = Shield(config) if shielded else None
        self._unicycle = Unicycle(config, num_rows) if is_unicycle else None
        self._drives_as_asked = not (impaired or shielded or is_unicycle)
        self.sensed: WorldState = self._known if self._senses is None else self._senses.sensed
        self.asked = np.zeros((2, num_rows), np.float32)
        self._command = np.zeros((2, num_rows), np.float32)
        self._command_x, self._command_y = self._command
        self._observation = np.zeros((num_rows, *self.method.observation_shape), self.method.observation_dtype)
        self._history = np.zeros((num_rows, config.history, *self.method.observation_shape), self._observation.dtype)
        self._reward = np.zeros(num_rows, np.float32)
        self.step_reward = np.zeros(num_rows, np.float32)
        self._running = np.ones(num_rows, np.bool_)  # rows whose robot takes part in the present decision
        self._is_running = np.ones(num_worlds, np.bool_)  # worlds of these
        self._ended_early = np.zeros(num_rows, np.bool_)
        self.outcome = np.zeros(num_rows, np.int8)
        self._steps = np.zeros(num_rows, np.int32)
        self.hit_learner = np.zeros(num_rows, np.bool_)
        self._all, self._all_rows = np.ones(num_worlds, np.bool_), np.ones(num_rows, np.bool_)
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
          Observations of all rows, a copy.
        """
        mask = self._all if mask is None else np.ascontiguousarray(mask)  # as kernels of `for_types_of` read it
        rows = self.rows_of(mask)
        self.scene.start(self._scene_state, mask)
        if self._several:
            self._draw_learners(self.state, mask, self._scene_state.learner, self._counts)
        self._reset_episode(self.state, mask)
        self.outcome[rows] = int(Outcome.RUNNING)
        self._refresh(rows)
        if self._senses is not None:
            self._senses.begin(rows)
        if self._unicycle is not None:
            self._unicycle.begin(self._known, rows)
        self.method.perceive(self.sensed, rows, self._observation)
        if self.config.history > 1:
            self._history[rows] = self._observation[rows, None]
        return self.observation()

    def rows_of(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """The rows `[num_rows]` of the worlds where `mask` `[num_worlds]` is set."""
        return np.repeat(mask, self._per_world) if self._several else mask

    def ended_worlds(self) -> NDArray[np.bool_]:
        """The worlds `[num_worlds]` whose learning robots' episodes have all ended."""
        return np.asarray(is_done(self.outcome).reshape(self.num_worlds, -1).all(axis=1))

    def _refresh(self, rows: NDArray[np.bool_]) -> None:
        """Brings what `sensed` and method are told of the world up to date for rows that run; others stay as ended."""
        if self._view is not None:
            self._view.refresh(rows)

    def observation(self) -> NDArray[Any]:
        """What the policy sees `[num_rows, size]`, a copy: with a history, the newest observation first.

        Where an observation is rows of groups, the row of a group holds its elements of all these observations.
        """
        if self.config.history == 1:
            return self._observation.copy()
        frames, rows = self._history, self.method.row_size
        if rows:
            frames = frames.reshape(self.num_rows, self.config.history, -1, rows).swapaxes(1, 2)
        return frames.reshape(self.num_rows, -1).copy()

    def step(self, action: Decision, watch: Callable[[], None] | None = None) -> StepResult:
        """Takes one decision in every world: `decision_interval_steps` simulator steps with the same action.

        A world that ends within the interval stays as it ended. Ended worlds are not restarted.

        Args:
          action: what the learning robots do; that of one whose episode has ended is not taken.
          watch: called after each simulator step.

        Returns:
          StepResult of copies.

        Raises:
          ValueError: there is not one action or velocity a learning robot, or one is none of the actions.
        """
        if action is Pilot.SNAPPED:
            action = self.actions_nearest_to_swarm()
        if isinstance(action, Command) and action.velocity.shape != self._command.shape:
            raise ValueError(f"velocities must be {self._command.shape}, not {action.velocity.shape}")
        begin_decision(self.outcome, self._running, self._is_running)
        decided = self._running.copy()
        unseen = decided.copy()  # rows whose observation is to be renewed
        self._reward.fill(0.0)
        for left in range(self.config.decision_interval_steps - 1, -1, -1):
            any_running = self._simulate(action, unseen)
            if watch is not None:
                watch()
            if left and not any_running:
                break
        self._perceive(unseen, decided)
        return StepResult(
            self.observation(),
            self._reward.copy(),
            self.outcome.copy(),
            self._steps.copy(),
            self.state.episode_return.copy(),
            decided,
        )

    def _perceive(self, unseen: NDArray[np.bool_], decided: NDArray[np.bool_]) -> None:
        self.method.perceive(self.sensed, unseen, self._observation)
        if self.config.history > 1:
            newest_first = [self._observation[:, None], self._history[:, :-1]]
            np.copyto(self._history, np.concatenate(newest_first, axis=1), where=decided[:, None, None])

    def _simulate(self, action: Decision, unseen: NDArray[np.bool_]) -> bool:
        """Moves the running worlds by one simulator step and adds its rewards; returns whether any still runs.

        Rows that end in worlds that go on observe their end at once, and are taken out of `unseen`.
        """
        running, is_running, early = self._running, self._is_running, self._ended_early
        if self.config.ended_learners == "leave":
            self._leave_worlds(self.state, running, is_running)
        is_given = self._give_command(action)
        command_x, command_y = self._command
        self._advance(self.state, self.tile, is_running, running, command_x, command_y, is_given, self.swarm)
        self._refresh(running)
        self.method.outcome(self._known, running, self.outcome)
        self.method.reward(self._known, running, self.outcome, self.step_reward)
        if self._senses is not None:
            self._senses.sense(running)
        if self._several:
            contact_sq = np.float32(2 * self.config.robot_radius_m) ** 2
            self._mark_learner_collisions(self.state, running, self.outcome, contact_sq, self.hit_learner)
        results = self.outcome, self.step_reward, self._reward, self._steps
        any_running, any_early = self._end_step(self.state, running, is_running, early, *results)
        if any_early:
            self.method.perceive(self.sensed, early, self._observation)
            unseen &= ~early
        return bool(any_running)

    def _give_command(self, action: Decision) -> bool:
        """Writes the velocities that the learning robots drive; returns False where FL-ORCA drives as it is."""
        command = self._command
        if isinstance(action, Pilot):
            if self._drives_as_asked:
                return False
            command[:] = self._swarm_velocity()
        elif isinstance(action, Command):
            command[:] = action.velocity
        else:
            self.method.velocity(self.sensed, action, self._command_x, self._command_y)
        if self._drives_as_asked:
            return True
        self.asked[:] = command
        if self._shield is not None:
            self._shield.project(self.sensed, self._running, self._command_x, self._command_y)
        if self._senses is not None:
            self._senses.drive(self._running, self._command_x, self._command_y)
        if self._unicycle is not None:
            self._unicycle.drive(self._running, self._command_x, self._command_y)
        return True

    def _swarm_velocity(self) -> NDArray[np.float32]:
        """The velocities `[2, num_rows]` (m/s) that FL-ORCA has for the learning robots by what they sense."""
        state, rows = WorldState(*(array.copy() for array in self.sensed)), np.arange(self.num_rows)
        has_view = self._view is not None
        world = rows if has_view else rows // self._per_world
        if has_view or not self._several:
            unknown = np.isnan(state.pos_x)
            for position in (state.pos_x, state.pos_y):
                np.copyto(position, position[world, state.learner][:, None] + np.float32(FAR_M), where=unknown)
            state.vel_x[unknown] = state.vel_y[unknown] = 0.0
        tile = world_tile(self.config, self.num_rows, np.float32) if has_view else self.tile
        mask, running = (self._all_rows, self._all_rows) if has_view else (self._all, ~is_done(self.outcome))
        advance(state, tile, mask, running if self._several else self._all_rows, *self._command, False, self.swarm)
        return np.stack([state.vel_x[world, state.learner], state.vel_y[world, state.learner]])

    def actions_nearest_to_swarm(self) -> NDArray[np.int64]:
        """The actions `[num_rows]` whose velocities are nearest to those that FL-ORCA has for the learning robots."""
        wanted = self._swarm_velocity()
        distance_sq = np.empty((self.config.num_actions, self.num_rows))
        velocity = np.empty((2, self.num_rows), np.float32)
        for action in range(self.config.num_actions):
            self.method.velocity(self.sensed, np.full(self.num_rows, action), velocity[0], velocity[1])
            distance_sq[action] = np.square(velocity - wanted).sum(axis=0)
        return np.asarray(distance_sq.argmin(axis=0), np.int64)

    def swarm_step(self) -> None:
        """Moves every world by one simulator step, the learning robot too, and nothing else: no outcome, no reward."""
        self._advance(self.state, self.tile, self._all, self._all_rows, *self._command, False, self.swarm)
        self._refresh(self._all_rows)

    def segregation(self) -> NDArray[np.float64]:
        """The fraction `[num_worlds]` of the pairs of groups that are segregated (Eq. 3.1)."""
        out = np.empty(self.num_worlds)
        segregated_fraction(self.state, np.empty(self.config.groups), out)
        return out

    def positions(self) -> NDArray[np.float32]:
        """Positions `[num_worlds, num_robots, 2]`, metres."""
        return np.stack([self.state.pos_x, self.state.pos_y], axis=-1)

    def sensed_positions(self) -> NDArray[np.float32]:
        """Positions as each learning robot senses them `[num_rows, num_robots, 2]`, metres; NaN where it does not."""
        position = np.stack([self.sensed.pos_x, self.sensed.pos_y], axis=-1)
        return np.repeat(position, self.num_rows // len(position), axis=0)

    def goals(self) -> NDArray[np.float32]:
        """Goals `[num_worlds, groups, 2]`, metres."""
        return np.stack([self.state.goal_x, self.state.goal_y], axis=-1)

    def _changing(self) -> dict[str, NDArray[Any]]:
        """The arrays that steps change."""
        changing = {name: array for name, array in self.state._asdict().items() if name not in CONSTANT}
        changing |= {} if self._senses is None else self._senses.arrays()
        changing |= {} if self._unicycle is None else self._unicycle.arrays()
        changing |= {"outcome": self.outcome} if self._several else {}
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
        rows = ~is_done(self.outcome) if self._several else self._all_rows  # those that wait observe nothing
        self._refresh(rows)
        self.method.perceive(self.sensed, rows, self._observation)
        return self.observation()

    def alone(self, mask: NDArray[np.bool_]) -> WorldBatch:
        """A batch of the worlds where `mask` `[num_worlds]` is set, as they are."""
        chosen = WorldBatch(self.config, int(mask.sum()))
        rows = self.rows_of(mask)
        state = {name: array[rows if len(array) == self.num_rows else mask] for name, array in self._changing().items()}
        chosen.set_state(state)
        return chosen


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
        worlds.step(rng.integers(config.num_actions, size=worlds.num_rows))
        done = worlds.ended_worlds()
        if done.any():
            worlds.reset(done)


def is_done(outcome: NDArray[np.int8]) -> NDArray[np.bool_]:
    """Where an episode has ended."""
    return np.not_equal(outcome, int(Outcome.RUNNING))


def is_terminated(outcome: NDArray[np.int8], timeout_fails: bool) -> NDArray[np.bool_]:
    """Where an episode has reached a terminal state; a timeout is one if it counts as a failure of the task."""
    return is_done(outcome) & (np.not_equal(outcome, int(Outcome.TIMEOUT)) | timeout_fails)
