"""What a learning robot costs where more robots of a world learn: its transitions, made by one rollout worker.

The robots of a world share the simulator's step; a robot that learns alone has a whole step to itself. `cost` is the
CPU time of a transition over that of the single learning robot of the same setup, with equally many worlds. First of a
whole rollout worker, whose network has random weights: most robots soon collide, and wait for their world's end (the
share that does not is `decide`). Then of the worlds' steps alone, which FL-ORCA drives, so that robots arrive.
"""

import itertools
import os
import time
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from actors.policy.mlp_kernels import Layers, forward, make_workspace, use_one_blas_thread
from actors.policy.policy import Policy, WeightsSnapshot
from actors.rollout.env_spec import EnvSpec
from actors.rollout.vector_env import env_shape
from actors.rollout.worker import RolloutSettings, RolloutWorker
from sim_core import ENV_ID
from sim_core.config import ONE_LEARNER, WorldConfig
from sim_core.jit import kernel
from sim_core.pilot import Pilot
from sim_core.worlds import WorldBatch
from tests.benchmarks.timing import Timed, pinned, ratio, spread, stopwatch, timed_rates

ROUNDS, BLOCK_STEPS = 7, 32
SETUPS = ((10, 2, 64), (10, 4, 64), (25, 8, 8))
"""Robots per group, groups, worlds."""
SHARES = (ONE_LEARNER, "0.25", "0.5", "1.0")
HIDDEN = (128, 128)
"""Of the default network."""
EPSILON = 0.05
BATCH = 1280
"""Observations of the network alone: the robots of 64 worlds of 20."""
WORLD: dict[str, Any] = {
    "max_neighbours": 16,
    "orca_radius_m": 0.18,
    "robot_radius_m": 0.06,
    "swarm_knows_learner": "yes",
}


def random_weights(sizes: tuple[int, ...]) -> WeightsSnapshot:
    """A network of so many inputs, hidden units and actions."""
    rng, arrays = np.random.default_rng(0), list[Any]()
    for fan_in, fan_out in itertools.pairwise(sizes):
        arrays += [rng.normal(0, fan_in**-0.5, (fan_out, fan_in)).astype(np.float32), np.zeros(fan_out, np.float32)]
    return WeightsSnapshot(0, 0.0, tuple(arrays))


class _Blocks:
    """Blocks of a rollout worker whose network has random weights; what is counted are the transitions in them.

    Attributes:
      deciding: share of the robots that decided in the last block.
    """

    def __init__(self, config: WorldConfig, worlds: int) -> None:
        spec = EnvSpec(ENV_ID, config)
        shape = env_shape(spec)
        settings = RolloutSettings(spec, worlds * config.num_learners, BLOCK_STEPS, 3, 0.99, 0)
        self._worker, self._most, self.deciding = RolloutWorker(settings, 0, 0), settings.num_envs * BLOCK_STEPS, 1.0
        self._weights = random_weights((shape.observation_size, *HIDDEN, shape.num_actions))
        for _ in range(8):  # compiles; worlds are then in all parts of their episodes
            self()

    def __call__(self) -> Timed:
        start_s = time.process_time()  # of this process alone: others may use the core, too
        self._worker.set_weights(self._weights)  # as after every block of a training, which brings new ones
        block = self._worker.collect(EPSILON)
        seconds = time.process_time() - start_s
        self.deciding = block.header.env_steps / self._most
        return Timed(block.transitions, seconds)


class _Steps:
    """Steps of worlds in which FL-ORCA drives the learning robots; what is counted are decisions."""

    def __init__(self, config: WorldConfig, worlds: int) -> None:
        self._worlds = WorldBatch(config, worlds)
        self._worlds.reset()
        self()

    def __call__(self) -> Timed:
        count, seconds = 0, 0.0
        for _ in range(BLOCK_STEPS):
            start_s = time.process_time()
            result = self._worlds.step(Pilot.FREE)
            seconds += time.process_time() - start_s
            count += int(np.count_nonzero(result.decided))
            ended = self._worlds.ended_worlds()
            if ended.any():
                self._worlds.reset(ended)
        return Timed(count, seconds)


def table(method: str) -> Table:
    """Transitions a second and their cost, for every setup and share of learning robots."""
    result = Table(title=f"{method}: one rollout worker, network {HIDDEN}; median (range) of {ROUNDS}")
    for name in (
        "setup",
        "learners",
        "of a world",
        "decide",
        "transitions/s",
        "cost",
        "steps alone, decisions/s",
        "cost",
    ):
        result.add_column(name, justify="right")
    for robots, groups, worlds in SETUPS:
        setup: dict[str, Any] = {"method": method, "robots": robots, "groups": groups, **WORLD}
        configs = {share: WorldConfig(learners=share, **setup) for share in SHARES}
        blocks = {share: _Blocks(config, worlds) for share, config in configs.items()}
        made = timed_rates(blocks, ROUNDS)
        stepped = timed_rates({share: _Steps(config, worlds) for share, config in configs.items()}, ROUNDS)
        for share, config in configs.items():
            row = [config.setup if share == ONE_LEARNER else "", share, str(config.num_learners)]
            row.append(f"{100 * blocks[share].deciding:.0f} %")
            for rates in (made, stepped):
                cost = ratio(rates[ONE_LEARNER], rates[share]).text(2) if share != ONE_LEARNER else "1"
                row += [f"{spread(rates[share]).median:,.0f}", cost]
            result.add_row(*row)
        result.add_section()
    return result


@kernel
def _by_blas(layers: Layers, workspace: tuple[Any, ...]) -> None:
    forward(layers, workspace)


def network_table() -> Table:
    """The network alone: observations a second with BLAS, which the learner uses, and with the policy's kernels.

    A quarter of the inputs is not 0, as of M_sensor's counts, or all are.
    """
    use_one_blas_thread()
    table = Table(title=f"network 16-128-128-8 alone, {BATCH} observations; median (range) of {ROUNDS}")
    for name in ("inputs that are not 0", "BLAS, observations/s", "policy, observations/s", "policy / BLAS"):
        table.add_column(name, justify="right")
    weights, rng = random_weights((16, *HIDDEN, 8)), np.random.default_rng(1)
    layers = Layers(weights.arrays[::2], weights.arrays[1::2])
    square, product = rng.normal(size=(2, 1024, 1024)).astype(np.float32)
    for share in (0.25, 1.0):
        observations = rng.normal(size=(BATCH, 16)) * (rng.random((BATCH, 16)) < share)
        workspace, policy = make_workspace(BATCH, layers), Policy(weights)
        workspace[0][:] = observations
        inputs = workspace[0].copy()

        def by_blas() -> int:
            for _ in range(20):
                _by_blas(layers, workspace)  # noqa: B023  # called in this pass of the loop
            return 20 * BATCH

        def by_policy() -> int:
            for _ in range(20):
                policy.values(inputs)  # noqa: B023
            return 20 * BATCH

        def multiply() -> int:
            np.dot(square, square, product)
            return 2 * 1024**3

        works = {"blas": by_blas, "policy": by_policy, "product": multiply}
        found = timed_rates({name: stopwatch(work, time.process_time) for name, work in works.items()}, ROUNDS)
        rates = (spread(found[name]).text() for name in ("blas", "policy"))
        table.add_row(f"{100 * share:.0f} %", *rates, ratio(found["policy"], found["blas"]).text(2))
    table.caption = f"a product of 1024 x 1024 floats: {spread(found['product']).median / 1e9:.0f} GFLOP/s"
    return table


def main(methods: tuple[str, ...] = ("sensor", "in", "out")) -> None:
    """Prints a table for each method."""
    with pinned(max(os.sched_getaffinity(0))):
        Console(width=140).print(network_table())
        for method in methods:
            Console(width=140).print(table(method))
