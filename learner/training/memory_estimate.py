"""A rough estimate of the memory that a run needs, which refuses at the start what this machine cannot hold."""

from __future__ import annotations

import itertools

import psutil

from actors.rollout.vector_env import EnvShape, env_shape
from actors.service.messages import transition_dtype
from actors.service.packing import estimate_frames, packed_dtype
from learner.config import RunConfig
from sim_core.checks import require

ROBOT_BYTES = 200
"""Bytes of one robot in one world: its state, neighbours and velocities."""
PROCESS_BYTES = 150_000_000
"""Bytes of an empty Ray actor: Python, PyTorch and the simulator's kernels."""
EPISODE_BYTES = 100
"""Bytes of one evaluated episode: its seed and its result."""
PRIORITY_BYTES = 32
"""Bytes of one transition's priority: two float64 per leaf of the sum tree, whose leaves are a power of 2."""
FRAME_PLACES = 2
"""Places per frame of the replay: their number is rounded up to a power of 2, so up to half are empty."""
NETWORK_COPIES = 5
"""Arrays of the size of the network: online and target network, gradients, and Adam's two moments."""


def bytes_by_setting(config: RunConfig, shape: EnvShape) -> dict[str, int]:
    """Bytes that a run needs, by the settings that decide them."""
    transition = transition_dtype(shape.observation_space)
    row, packed = transition.itemsize, packed_dtype(transition).itemsize
    frames = estimate_frames(config.replay_capacity, config.steps_per_block, config.n_step)
    priority = PRIORITY_BYTES if config.replay == "prioritised" else 0
    widths = [shape.observation_size, *config.policy_sizes, shape.num_actions]
    weights = sum(inputs * outputs + outputs for inputs, outputs in itertools.pairwise(widths))
    robots = max(world.num_robots for world in config.env.worlds) if config.env.is_swarm else 1
    rows = sum(config.env.counts(config.envs_per_worker))
    actors = config.workers + (config.replay_shards if config.replay_placement == "actors" else 0)
    return {
        "workers, envs_per_worker and robots": config.workers * rows * robots * ROBOT_BYTES,
        "workers and replay_shards": actors * PROCESS_BYTES if config.engine == "ray" else 0,
        "envs_per_worker, steps_per_block and n_step": config.workers
        * rows
        * (config.steps_per_block + config.n_step)
        * row,
        "replay_capacity": config.replay_capacity * (packed + priority)
        + FRAME_PLACES * frames * transition["observation"].itemsize,
        "batch_size and updates_per_call": 4 * config.batch_size * config.updates_per_call * row,
        "hidden_sizes": 4 * NETWORK_COPIES * weights,
        "eval_episodes and final_eval_episodes": EPISODE_BYTES * max(config.eval_episodes, config.final_eval_episodes),
    }


def check_fits(config: RunConfig) -> EnvShape:
    """Checks that this machine has the memory for a run; returns the spaces of its environment.

    Raises:
      ConfigError: it has not, or the environment cannot be made.
    """
    shape = env_shape(config.env)
    needs, total = bytes_by_setting(config, shape), psutil.virtual_memory().total
    largest = max(needs, key=lambda settings: needs[settings])
    need = sum(needs.values())
    require(
        need <= total,
        f"{config.name} needs about {_gigabytes(need)} of memory, {_gigabytes(needs[largest])} of it by {largest}, "
        f"and this machine has {_gigabytes(total)}: lower them, or train on a cluster (--address)",
    )
    return shape


def _gigabytes(count: int) -> str:
    return f"{count // 10**9:,} GB" if count >= 10**10 else f"{count / 1e9:.1f} GB"
