"""The loop of both contenders in JAX: worlds by `vmap`, a step by `jit`."""

from collections.abc import Callable
from typing import Any

import jax

from tests.benchmarks.robot_contenders.turns import Job


def steps_of(reset: Callable[..., Any], step_world: Callable[..., Any], job: Job) -> Callable[[], int]:
    """A function that steps all worlds once and waits for what they return.

    Args:
      reset: key to (observations, state) of one world.
      step_world: key, state and actions `[robots, 2]` in -1 .. 1 of one world to (observations, state, *rest).
      job: how many robots and worlds.
    """
    keys = jax.random.split(jax.random.key(0), job.worlds)
    actions = jax.random.uniform(jax.random.key(1), (job.worlds, job.robots, 2), minval=-1.0)
    step_all = jax.jit(jax.vmap(step_world))
    _, state = jax.jit(jax.vmap(reset))(keys)

    def step() -> int:
        nonlocal state
        observations, state, *rest = step_all(keys, state, actions)
        jax.block_until_ready((observations, state, rest))
        return job.robots * job.worlds

    return step
