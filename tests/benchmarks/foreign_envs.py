"""What the checks of foreign environments cost: CartPole beside Gymnasium's own vector environment, without checks."""

import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from rich.console import Console
from rich.table import Table

from actors.rollout.foreign_env import ForeignVectorEnv
from tests.benchmarks.timing import ratio, spread, stopwatch, timed_rates

ENV_ID, ENVS, STEPS, ROUNDS = "CartPole-v1", 64, 400, 25
GYMNASIUM = "gymnasium.vector.SyncVectorEnv"


class Unchecked(ForeignVectorEnv):
    """Takes numbers as they are."""

    def _check_finite(self, *arrays: Any) -> None:
        pass


def steps_of(env: gym.vector.VectorEnv[Any, Any, Any]) -> Callable[[], int]:
    """Work: `STEPS` steps of all environments, with the same actions in every round."""
    actions = np.random.default_rng(0).integers(2, size=(STEPS, ENVS))

    def work() -> int:
        env.reset(seed=list(range(ENVS)))  # type: ignore[arg-type]  # every VectorEnv takes a list
        for each in actions:
            env.step(each)
        return STEPS * ENVS

    return work


def main() -> None:
    mode = {"autoreset_mode": AutoresetMode.SAME_STEP}
    rivals: dict[str, gym.vector.VectorEnv[Any, Any, Any]] = {
        GYMNASIUM: gym.make_vec(ENV_ID, num_envs=ENVS, vectorization_mode="sync", vector_kwargs=mode),
        "ours, checked": ForeignVectorEnv(ENV_ID, ENVS),
        "ours, without the check of numbers": Unchecked(ENV_ID, ENVS),
    }
    works = {name: stopwatch(steps_of(env), time.process_time) for name, env in rivals.items()}
    found = timed_rates(works, ROUNDS)
    table = Table(title=f"{ENV_ID}, {ENVS} environments in turn: env steps per CPU second, {ROUNDS} rounds")
    for column in ("vector environment", "env steps / CPU s", "ratio"):
        table.add_column(column, justify="right")
    for name, values in found.items():
        table.add_row(name, spread(values).text(), ratio(values, found[GYMNASIUM]).text(3))
    Console(width=120).print(table)
