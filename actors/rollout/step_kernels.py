"""What a rollout worker chooses and writes down in every env step, by kernels: numpy would take a call an array."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.rollout.exploration import GREEDY
from sim_core.jit import kernel


def explore(greedy: NDArray[np.int64], random_actions: NDArray[np.int64]) -> NDArray[np.int64]:
    """Actions `[batch]`: those of `random_actions` `[batch]`, and those of `greedy` `[batch]` where they are GREEDY."""
    actions = random_actions.copy()
    _fill_greedy(actions, greedy)
    return actions


@kernel
def _fill_greedy(actions: NDArray[np.int64], greedy: NDArray[np.int64]) -> None:
    for i in range(len(actions)):
        if actions[i] == GREEDY:
            actions[i] = greedy[i]


class StepLog(NamedTuple):
    """Arrays `[steps, num_envs]` of a block: columns of its Steps, and length and return of the episodes that end."""

    action: NDArray[np.int64]
    reward: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    done: NDArray[np.bool_]
    decided: NDArray[np.bool_]
    length_steps: NDArray[np.int32]
    episode_return: NDArray[np.float64]


@kernel
def record_step(
    log: StepLog,
    step: int,
    action: NDArray[np.int64],
    reward: NDArray[np.float64],
    terminated: NDArray[np.bool_],
    truncated: NDArray[np.bool_],
    length_steps: NDArray[np.int32],
    episode_return: NDArray[np.float64],
) -> int:
    """Writes an env step to row `step` of the log.

    Args:
      log: StepLog, changed in place, but for `decided`: an episode is as long as it has steps that are.
      step: number of the step in the block.
      action, reward, terminated, truncated: `[num_envs]`, of the step.
      length_steps, episode_return: `[num_envs]`, of the present episodes so far; changed in place, 0 where one ended.

    Returns:
      The number of episodes that ended.
    """
    ended = 0
    for env in range(action.shape[0]):
        done = terminated[env] or truncated[env]
        log.action[step, env], log.reward[step, env] = action[env], reward[env]
        log.terminated[step, env], log.done[step, env] = terminated[env], done
        length_steps[env] += log.decided[step, env]
        episode_return[env] += reward[env]
        log.length_steps[step, env], log.episode_return[step, env] = length_steps[env], episode_return[env]
        if done:
            length_steps[env], episode_return[env] = 0, 0.0
            ended += 1
    return ended
