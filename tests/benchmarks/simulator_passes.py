"""Where the time of a step goes: the processor's cycle counter is read between the passes of real episodes.

`_timed_advance` is `sim_core.swarm.step.advance` with a timer around each pass. It makes the same calls.
"""

import time
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from rich.table import Table

from sim_core.config import WorldConfig
from sim_core.jit import kernel
from sim_core.lanes import load, scatter
from sim_core.orca import build_half_planes, orca_velocity
from sim_core.swarm import step
from sim_core.swarm.flocking import preferred_velocity
from sim_core.swarm.neighbours import find_neighbours, list_start
from sim_core.worlds import WorldBatch

SETUPS = ((5, 2), (10, 4), (25, 8))
NUM_WORLDS = 64
EPISODE_STEPS = 240
EPISODES = 4
PASSES = (
    "copy the old state in",
    "neighbours",
    "flock terms, followers",
    "preferred velocity",
    "half-planes",
    "linear programs",
    "move",
)


@intrinsic
def _cycles(typingctx: Any) -> Any:
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = ir.FunctionType(ir.IntType(64), [])
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, "llvm.readcyclecounter"), [])

    return types.int64(), lower


@kernel
def _timed_advance(state, tile, running, command, spent, params):
    p = params[0]
    num_worlds, size = state.pos_x.shape
    for first in range(0, num_worlds, p.worlds_per_tile):
        worlds, index = min(p.worlds_per_tile, num_worlds - first), first // p.worlds_per_tile
        t = _cycles()
        rows = step.load_tile(first, worlds, state, running, tile, p)
        spent[0] += _cycles() - t
        t = _cycles()
        for row in range(rows):
            find_neighbours(row, index, size, worlds * size, tile, p.neighbours)
        spent[1] += _cycles() - t
        t = _cycles()
        step.run_flocking_passes(index, rows, tile, state.rng, p)
        spent[2] += _cycles() - t
        for row in range(rows):
            t = _cycles()
            robot, count = load(tile.row_slots, row), tile.neighbour_counts[row]
            start = list_start(row, index, tile, p.neighbours)
            pref_x, pref_y = preferred_velocity(row, tile, p.flock)
            spent[3] += _cycles() - t
            t = _cycles()
            build_half_planes(robot, tile.pos_vel, tile.neighbours, start, count, tile.lines, p.orca)
            spent[4] += _cycles() - t
            t = _cycles()
            x, y = orca_velocity(tile.lines, count, pref_x, pref_y, tile.projected, p.orca)
            scatter(tile.new_vx, robot, x)
            scatter(tile.new_vy, robot, y)
            spent[5] += _cycles() - t
        t = _cycles()
        for i in range(worlds):
            step.move_world(first + i, i * size, state, running, tile, command, command, False, p)
        spent[6] += _cycles() - t


def pass_ns(config: WorldConfig) -> list[float]:
    """Nanoseconds a robot step of every pass, over episodes of FL-ORCA alone from their start."""
    worlds = WorldBatch(config, NUM_WORLDS)
    command, spent = np.zeros(NUM_WORLDS, np.float32), np.zeros(len(PASSES), np.int64)
    running = np.ones(NUM_WORLDS, np.bool_)
    _timed_advance(worlds.state, worlds.tile, running, command, spent, worlds.swarm)
    spent[:] = 0
    start_s, start_cycles = time.perf_counter(), _now()
    for _ in range(EPISODES):
        worlds.reset()
        for _ in range(EPISODE_STEPS):
            _timed_advance(worlds.state, worlds.tile, running, command, spent, worlds.swarm)
    ns_per_cycle = 1e9 * (time.perf_counter() - start_s) / (_now() - start_cycles)
    robot_steps = EPISODES * EPISODE_STEPS * NUM_WORLDS * config.num_robots
    return [float(ns_per_cycle * cycles / robot_steps) for cycles in spent]


@kernel
def _now():
    return _cycles()


def table() -> Table:
    columns = {config.setup: pass_ns(config) for config in (WorldConfig(robots=r, groups=g) for r, g in SETUPS)}
    result = Table(
        title=f"where the time of a step goes: ns a robot step (share), {NUM_WORLDS} worlds, one core, full FL-ORCA",
        caption=f"{EPISODES} episodes of {EPISODE_STEPS} steps; perception, reward and outcome are not in it",
    )
    result.add_column("pass")
    for setup in columns:
        result.add_column(setup, justify="right")
    for i, name in enumerate(PASSES):
        result.add_row(name, *(f"{ns[i]:.0f} ({ns[i] / sum(ns):.0%})" for ns in columns.values()))
    result.add_row("sum", *(f"{sum(ns):.0f}" for ns in columns.values()))
    return result
