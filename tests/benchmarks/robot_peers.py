"""`make bench-robots`: steps of learning robots a second, beside a peer that simulates many robots on a CPU.

All robots of a world learn and act at random, on one core; what counts for shoal are decisions that were taken, since a
robot whose episode has ended waits for its world. VMAS has no end of an episode here. Contenders take turns, with
equally many worlds.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from sim_core.config import WorldConfig
from sim_core.envs import SwarmVectorEnv
from tests.benchmarks.timing import Timed, pinned, ratio, spread, timed_rates

SETUPS = ((5, 2), (10, 4))
"""Robots per group, groups: 10 and 40 robots."""
WORLDS = {10: 256, 40: 64}
"""Worlds, by the robots of each."""
METHODS = ("sensor", "in", "out")
ROUNDS, STEPS, WARM_UP = 5, 20, 5
WORLD: dict[str, Any] = {"max_neighbours": 16, "orca_radius_m": 0.18, "robot_radius_m": 0.06}
SIMULATES = {
    "shoal": "velocities; every robot that has ended follows FL-ORCA; observation of the method, reward, outcome",
    "VMAS flocking": "forces on spheres that push each other off, obstacles; 12 lidar rays a robot; no avoidance",
}


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.robot_peers", description=__doc__)
    parser.add_argument("--vmas", type=Path, required=True, help="folder that VMAS was installed to (pip --target)")
    return parser.parse_args(arguments)


class _Ours:
    """A vector environment whose rows are robots, with random actions."""

    def __init__(self, method: str, robots: int, groups: int, worlds: int) -> None:
        config = WorldConfig(method=method, robots=robots, groups=groups, learners="1.0", **WORLD)
        setup = {"method": method, "robots": robots, "groups": groups, "learners": "1.0", **WORLD}
        self._env = SwarmVectorEnv(worlds * config.num_learners, **setup)
        self._rng, self._actions = np.random.default_rng(0), config.num_actions
        self._env.reset(seed=0)
        for _ in range(WARM_UP):  # worlds are then in all parts of their episodes
            self()

    def __call__(self) -> Timed:
        action = self._rng.integers(self._actions, size=(STEPS, self._env.num_envs))
        count, start_s = 0, time.process_time()  # of this process alone: others may use the core, too
        for row in action:
            count += int(np.count_nonzero(self._env.step(row)[4]["decided"]))
        return Timed(count, time.process_time() - start_s)


class _Vmas:
    """VMAS's scenario `flocking` with random actions."""

    def __init__(self, robots: int, worlds: int) -> None:
        import vmas

        make: Callable[..., Any] = vmas.make_env
        self._env = make("flocking", worlds, device="cpu", continuous_actions=False, seed=0, n_agents=robots)
        self._env.reset()
        self._robots, self._worlds = robots, worlds
        self._steps = max(1, 100 // robots)

    def __call__(self) -> Timed:
        shape = self._steps, self._robots, self._worlds
        action = torch.randint(5, shape, generator=torch.Generator().manual_seed(0))
        start_s = time.process_time()
        for row in action:
            self._env.step(list(row))
        return Timed(self._steps * self._robots * self._worlds, time.process_time() - start_s)


def table() -> Table:
    """Robot steps a second of all contenders, for every number of robots."""
    result = Table(title=f"steps of observed, learning robots on one core, median (range) of {ROUNDS}")
    for name in ("robots", "contender", "worlds", "env steps/s", "robot steps/s", "shoal / it"):
        result.add_column(name, justify="left" if name == "contender" else "right")
    for size, groups in SETUPS:
        robots, worlds = size * groups, WORLDS[size * groups]
        found: dict[str, Callable[[], Timed]] = {
            f"shoal, {method}": _Ours(method, size, groups, worlds) for method in METHODS
        }
        rates = timed_rates(found | {"VMAS flocking": _Vmas(robots, worlds)}, ROUNDS)
        for name, measured in rates.items():
            steps = spread(measured)
            ours = [ratio(rates[f"shoal, {method}"], measured).median for method in METHODS]
            against = " … ".join(f"{times:.0f}" for times in ours) if name.startswith("VMAS") else ""
            result.add_row(f"{robots}", name, f"{worlds}", f"{steps.median / robots:,.0f}", steps.text(), against)
        result.add_section()
    return result


def main(arguments: list[str] | None = None) -> int:
    sys.path.append(str(parse(arguments).vmas))
    torch.set_num_threads(1)
    console = Console(width=140)
    with pinned(max(os.sched_getaffinity(0))):
        console.print(table())
    for name, what in SIMULATES.items():
        console.print(f"{name}: {what}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
