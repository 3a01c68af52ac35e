"""What a robot's step costs in one large world.

The scene: robots on a square lattice, each shifted at random, dealt at random to four groups that head in four
directions for goals far outside. The start scene of `WorldConfig` would not do, as its density is not that of the
crossing, and a larger crossing lasts longer; here every robot is in the thick of it from the first step, the density
is the same for any number of robots, and four equal streams keep it for the second that is run before the scene is set
back (untimed). The lattice's spacing gives as many robots in range, about 20, as there are over an episode of 25r×8g.

At the border there are fewer neighbours, and the border is a larger part of a small world: the column of neighbours
tells how much less work that is. A call has a fixed cost, which weighs more on 100 robots than on 10,000: hence the row
with many worlds, which has as many robots a call as the largest world.
"""

import math
from collections.abc import Callable

import numpy as np
from rich.table import Table
from scipy.spatial import cKDTree

from sim_core.config import WorldConfig
from sim_core.worlds import WorldBatch
from tests.benchmarks.timing import Timed, seconds_of_steps, spread, timed_rates

SIZES = ((100, 1), (1_000, 1), (10_000, 1), (100, 100))  # robots a world, worlds; the first is the measure
GROUPS = 4
SPACING_M, JITTER_M = 0.6, 0.1
GOAL_DISTANCE_M = 1e4
STEPS = 20
ROBOT_STEPS = 200_000
ROUNDS = 5


def streams(robots: int, num_worlds: int) -> WorldBatch:
    """Worlds in the scene described above."""
    config = WorldConfig(robots=robots // GROUPS, groups=GROUPS, arena_radius_m=6.0 * math.sqrt(robots / 100))
    worlds = WorldBatch(config, num_worlds)
    worlds.reset()
    state, rng = worlds.get_state(), np.random.default_rng(0)
    angle = 2 * np.pi * np.arange(GROUPS) / GROUPS
    heading = np.stack([np.cos(angle), np.sin(angle)])
    columns = math.ceil(math.sqrt(robots))
    for world in range(num_worlds):
        cell = rng.permutation(robots)
        place = SPACING_M * np.stack(np.divmod(cell, columns)) + rng.uniform(-JITTER_M, JITTER_M, (2, robots))
        velocity = np.repeat(heading, robots // GROUPS, axis=1) * config.max_speed_m_s
        for axis, name in enumerate("xy"):
            state[f"pos_{name}"][world, :robots] = place[axis]
            state[f"vel_{name}"][world, :robots] = velocity[axis]
            state[f"goal_{name}"][world, :GROUPS] = GOAL_DISTANCE_M * heading[axis]
    worlds.set_state(state)
    return worlds


def step_work(worlds: WorldBatch) -> Callable[[], Timed]:
    start = worlds.get_state()
    robot_steps = STEPS * worlds.num_worlds * worlds.config.num_robots

    def work() -> Timed:
        repeats = max(1, ROBOT_STEPS // robot_steps)
        seconds = sum(seconds_of_steps(worlds, start, STEPS) for _ in range(repeats))
        return Timed(repeats * robot_steps, seconds)

    return work


def mean_neighbours(worlds: WorldBatch) -> float:
    """Robots that ORCA looks at, on average over the first world."""
    position = worlds.positions()[0]
    in_range = cKDTree(position).query_ball_point(position, worlds.config.neighbour_range_m, return_length=True) - 1
    return float(np.minimum(in_range, worlds.config.max_neighbours).mean())


def table() -> Table:
    batches = {size: streams(*size) for size in SIZES}
    before = {size: mean_neighbours(worlds) for size, worlds in batches.items()}
    found = timed_rates({size: step_work(worlds) for size, worlds in batches.items()}, ROUNDS)
    cost = {size: [1e9 / rate for rate in rates] for size, rates in found.items()}
    result = Table(
        title=f"FL-ORCA at one density, one core, median (lowest … highest) of {ROUNDS}",
        caption=f"neighbours: on average, before … after the {STEPS} steps",
    )
    for column in ("robots a world", "worlds", "neighbours", "ns/robot step", "of the first row"):
        result.add_column(column, justify="right")
    for size, worlds in batches.items():
        relative = spread([a / b for a, b in zip(cost[size], cost[SIZES[0]], strict=True)])
        around = f"{before[size]:.2f} … {mean_neighbours(worlds):.2f}"
        result.add_row(f"{size[0]:,}", f"{size[1]:,}", around, spread(cost[size]).text(), relative.text(2))
    return result
