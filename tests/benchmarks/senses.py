"""What bad senses and the shield cost: time of whole steps beside that of the same worlds without them, in turn."""

import dataclasses
import os
import time
from typing import Any

from rich.console import Console
from rich.table import Table

from sim_core.config import WorldConfig
from sim_core.worlds import WorldBatch, is_done
from tests.benchmarks.timing import Timed, pinned, ratio, spread, timed_rates

NUM_WORLDS, STEPS, ROUNDS = 64, 200, 9
SETUPS = ((5, 2), (10, 4), (25, 8))
WORLD: dict[str, Any] = {"max_neighbours": 16, "orca_radius_m": 0.18, "robot_radius_m": 0.06}
LOST = {"position_loss": 0.25, "dropped_mates": 1}
ALL = {
    "position_noise_m": 0.05,
    **LOST,
    "burst_loss": 0.1,
    "position_delay_steps": 4,
    "sensing_range_m": 5.0,
    "field_of_view_deg": 270.0,
    "group_mix_up": 0.01,
    "command_delay_steps": 2,
    "speed_error": 0.1,
    "heading_error_deg": 5.0,
}
VARIANTS: dict[str, dict[str, Any]] = {
    "without effect": {"sensing_range_m": 1e6},
    "noise": {"position_noise_m": 0.05},
    "loss": LOST,
    "delay": {"position_delay_steps": 4},
    "all conditions": ALL,
    "shield": {"shield": "orca"},
}


class _Steps:
    """Steps of worlds that the method's rule `greedy` drives; ended episodes restart. Only the steps are timed."""

    def __init__(self, config: WorldConfig) -> None:
        self._worlds = WorldBatch(config, NUM_WORLDS)
        self._rule = config.method_class.rules(config)["greedy"]
        self._observation = self._worlds.reset()

    def __call__(self) -> Timed:
        seconds = 0.0
        for _ in range(STEPS):
            action = self._rule(self._observation)
            start_s = time.process_time()  # of this process alone: others may use the core, too
            result = self._worlds.step(action)
            seconds += time.process_time() - start_s
            done = is_done(result.outcome)
            self._observation = self._worlds.reset(done) if done.any() else result.observation
        return Timed(STEPS * NUM_WORLDS, seconds)


def table(method: str) -> Table:
    """Time of a step with each variant over that without."""
    result = Table(title=f"{method}: time of a step over that without, {NUM_WORLDS} worlds, median (range) of {ROUNDS}")
    for name in ("setup", "env steps/s without", *VARIANTS):
        result.add_column(name, justify="right")
    for robots, groups in SETUPS:
        plain = WorldConfig(method=method, robots=robots, groups=groups, **WORLD)
        rivals = {"plain": _Steps(plain)}
        rivals |= {name: _Steps(dataclasses.replace(plain, **fields)) for name, fields in VARIANTS.items()}
        found = timed_rates(rivals, ROUNDS)
        costs = [ratio(found["plain"], found[name]).text(2) for name in VARIANTS]
        result.add_row(plain.setup, f"{spread(found['plain']).median:,.0f}", *costs)
    return result


def main(methods: tuple[str, ...] = ("sensor", "in", "out")) -> None:
    """Prints a table for each method."""
    with pinned(max(os.sched_getaffinity(0))):
        for method in methods:
            Console(width=160).print(table(method))
