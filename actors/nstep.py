"""n-step transitions of many environments, a block at a time (Sutton and Barto, 2nd edition, Section 7.1)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class Steps(NamedTuple):
    """Consecutive env steps of many environments, each array `[steps, num_envs, ...]`.

    observation, action: what was seen and done.
    reward: float64.
    reached: the state that the step led to, an ended episode's last where `done`.
    terminated: where the task ended.
    done: where the episode ended, by the task or by the clock.
    """

    observation: NDArray[Any]
    action: NDArray[np.int64]
    reward: NDArray[np.float64]
    reached: NDArray[Any]
    terminated: NDArray[np.bool_]
    done: NDArray[np.bool_]


def empty_steps(steps: int, num_envs: int, dtype: np.dtype[Any]) -> Steps:
    """Zeroed Steps for rows of `dtype` (`actors.transitions.transition_dtype`)."""
    observation = dtype["observation"]
    seen = (steps, num_envs, *observation.shape)
    return Steps(
        observation=np.zeros(seen, observation.base),
        action=np.zeros((steps, num_envs), np.int64),
        reward=np.zeros((steps, num_envs)),
        reached=np.zeros(seen, observation.base),
        terminated=np.zeros((steps, num_envs), np.bool_),
        done=np.zeros((steps, num_envs), np.bool_),
    )


class NStepAssembler:
    """Turns env steps into transitions over `n_step` steps, cut short where an episode ends.

    The last `n_step - 1` steps are kept: those that have not seen `n_step` rewards wait for the next block.

    Args:
      dtype: the row (`actors.transitions.transition_dtype`).
      num_envs: number of environments.
      n_step: steps a transition spans.
      discount: gamma.
    """

    def __init__(self, dtype: np.dtype[Any], num_envs: int, n_step: int, discount: float) -> None:
        self._dtype = dtype
        self._n_step = n_step
        self._powers = discount ** np.arange(n_step + 1)
        self._kept = empty_steps(n_step - 1, num_envs, dtype)
        self._waits = np.zeros((n_step - 1, num_envs), np.bool_)

    def push(self, steps: Steps) -> NDArray[Any]:
        """Takes the next env steps and returns the transitions that they complete, oldest first.

        Kept steps that wait are of running episodes, so that every one of them ends in a new step.
        """
        kept = self._n_step - 1
        window = Steps(*(np.concatenate(pair) for pair in zip(self._kept, steps, strict=True)))
        open_steps = np.concatenate([self._waits, np.ones_like(steps.done)])
        value, span, ended, terminal = self._look_ahead(window, open_steps)
        whole = np.arange(len(open_steps)) <= len(open_steps) - self._n_step
        ready = open_steps & (ended | whole[:, None])
        step, env = np.nonzero(ready)
        rows = np.zeros(len(step), self._dtype)
        rows["observation"] = window.observation[step, env]
        rows["action"] = window.action[step, env]
        rows["reward"] = value[step, env]
        rows["discount"] = np.where(terminal[step, env], 0.0, self._powers[span[step, env]])
        rows["next_observation"] = window.reached[step + span[step, env] - 1, env]
        newest = slice(len(open_steps) - kept, None)
        for mine, array in zip(self._kept, window, strict=True):
            mine[...] = array[newest]
        self._waits = open_steps[newest] & ~ready[newest]
        self._kept.done[:] = False  # what waits belongs to running episodes; the rest is of no use any more
        return rows

    def _look_ahead(
        self, window: Steps, open_steps: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_]]:
        """Of every open step: its n-step return, the steps in it, whether the episode ends there, and the task."""
        value, span = np.zeros(open_steps.shape), np.zeros(open_steps.shape, np.int64)
        ended, terminal = np.zeros_like(open_steps), np.zeros_like(open_steps)
        running = open_steps.copy()
        for ahead in range(self._n_step):
            here = slice(0, max(0, len(open_steps) - ahead))
            there = slice(ahead, None)
            value[here] += np.where(running[here], self._powers[ahead] * window.reward[there], 0.0)
            span[here] += running[here]
            ends = running[here] & window.done[there]
            ended[here] |= ends
            terminal[here] |= ends & window.terminated[there]
            running[here] &= ~ends
        return value, span, ended, terminal

    def clear(self) -> None:
        """Forgets all waiting steps."""
        self._waits[:] = False

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Copies of all that a checkpoint needs."""
        names = ("observation", "action", "reward")
        return {f"kept_{name}": getattr(self._kept, name).copy() for name in names} | {"waits": self._waits.copy()}

    def set_state(self, saved: dict[str, NDArray[Any]]) -> None:
        """Takes up what `get_state` gave."""
        for name in ("observation", "action", "reward"):
            getattr(self._kept, name)[...] = saved[f"kept_{name}"]
        self._waits = saved["waits"].copy()
