"""Records an episode of the swarm environment while something drives the learning robot."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from actors.evaluation.trajectory import BY_HAND, NO_ACTION, Episode
from sim_core.config import WorldConfig
from sim_core.outcomes import Outcome
from sim_core.pilot import Pilot
from sim_core.worlds import Command, Decision, WorldBatch


class Recording:
    """One episode, from its start to as far as it was stepped.

    Args:
      config: the world.
      seed: of the episode.
      number: where several robots of the world learn, the one whose episode it is, which is the learning robot of the
        record; by default the seed modulo their number.

    Attributes:
      observation: `[learners, *shape]`, what a policy sees now.
      outcome: RUNNING until the episode ends.
    """

    def __init__(self, config: WorldConfig, seed: int, number: int | None = None) -> None:
        self._config, self._seed = config, seed
        self._worlds = WorldBatch(config, 1)
        self._row = seed % self._worlds.num_rows if number is None else number
        self._worlds.seed([seed])
        self.observation: NDArray[Any] = self._worlds.reset()
        self.outcome = Outcome.RUNNING
        self._rows: dict[str, list[NDArray[Any]]] = {
            name: [] for name in ("position", "velocity", "machine", "sensed", "asked")
        }
        self._actions, self._rewards = list[int](), list[float]()
        self._keep_state()

    @property
    def steps(self) -> int:
        """Simulator steps so far."""
        return len(self._actions)

    def step(self, action: Decision) -> Outcome:
        """Takes one decision; returns the outcome.

        It lasts `decision_interval_steps` simulator steps, or as many as the episode has left.
        """
        taken, row = int(action[self._row]) if isinstance(action, np.ndarray) else _driver(action), self._row

        def keep() -> None:
            if self.outcome != Outcome.RUNNING:
                return  # other learning robots of the world go on
            self._actions.append(taken)
            self._rewards.append(float(self._worlds.step_reward[row]))
            self._rows["asked"].append(self._worlds.asked[:, row].copy())
            self._keep_state()
            self.outcome = Outcome(self._worlds.outcome[row])

        self.observation = self._worlds.step(action, keep).observation
        return self.outcome

    def _keep_state(self) -> None:
        state, rows = self._worlds.state, self._rows
        rows["position"].append(self._worlds.positions()[0])
        rows["velocity"].append(np.stack([state.vel_x[0], state.vel_y[0]], axis=-1))
        rows["machine"].append(state.machine[0].copy())
        rows["sensed"].append(self._worlds.sensed_positions()[self._row])

    def episode(self, first: int = 0) -> Episode:
        """The states after the first `first` simulator steps, and what was done in them; of all steps by default."""
        rows = {name: np.stack(self._rows[name][first:]) for name in ("position", "velocity", "machine")}
        if self._config.senses_badly:
            rows["sensed"] = np.stack(self._rows["sensed"][first:])
        if self._config.corrects_commands:
            rows["asked"] = np.stack([*self._rows["asked"][first:], np.zeros(2, np.float32)])
        return Episode(
            **rows,
            action=np.array([*self._actions[first:], NO_ACTION], np.int64),
            reward=np.array([*self._rewards[first:], 0.0], np.float32),
            goal=self._worlds.goals()[0],
            learner=int(self._worlds.state.learner[self._row]),
            outcome=int(self.outcome),
            seed=self._seed,
        )


def _driver(action: Pilot | Command) -> int:
    """What an episode has in place of an action."""
    return BY_HAND if isinstance(action, Command) else NO_ACTION
