"""How exact the simulator is, in numbers: `python -m tests.benchmarks.exactness`.

Sections: `scenes`, one step of random scenes against RVO2 (pyrvo); `episodes`, steps along whole episodes against
RVO2; `float32`, the same kernels in float32 and float64; `swarm`, FL-ORCA alone over whole episodes.
Exits with 1 when a bound of the first three is broken, or when in the last two robots overlap or one is too fast
or not finite; arrivals and segregation are measured, not judged.
"""

import argparse
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from tests.benchmarks import exactness_work as work
from tests.sim_core.orca_scenes import KINDS
from tests.sim_core.parity import BOUND_M_S, SETTINGS, Parity, total
from tests.sim_core.precision import DRIFT_STEPS

CONSOLE = Console(width=160)
SWARM_SETUPS = [(robots, groups) for robots in (5, 10, 15, 20, 25) for groups in (1, 2, 3, 4, 8)]
EPISODE_SETUPS = ((5, 1), (5, 8), (10, 2), (15, 3), (20, 4), (25, 2), (25, 8))
EVERY_STEPS = 10
DRIFT_SETUPS = ((5, 3), (10, 2), (25, 8))
DRIFT_STARTS = (0, 50, 100, 150, 200, 250, 300)
NEAR_FLOAT64_M_S = 1e-4
"""Nine robots in ten of every kind of scene must be this near to float64 after one step."""
SPEED_ROUNDING = 1 + 1e-5
PARITY_COLUMNS = ("scenes", "robots", "bit for bit", "largest difference, m/s", "none permitted", "RVO2 too fast",
                  "ties", "coincident", "unexplained")  # fmt: skip
SWARM_COLUMNS = ("episodes", "with overlap", "steps with overlap", "smallest distance, m", "largest speed, m/s",
                 "arrived", "median arrival, steps")  # fmt: skip

Run = Callable[[Callable[..., Any], list[tuple[Any, ...]]], list[Any]]


def main(argv: list[str] | None = None) -> int:
    options = parse(argv)
    ok = True
    with runner(options.processes) as run:
        for name in options.sections:
            start_s = time.perf_counter()
            ok &= SECTIONS[name](run, options)
            CONSOLE.print(f"{name}: {time.perf_counter() - start_s:.0f} s on {options.processes} processes\n")
    CONSOLE.print("every bound holds" if ok else "a bound is broken")
    return 0 if ok else 1


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.exactness", description=__doc__)
    parser.add_argument("--sections", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--scenes", type=int, default=12_000, help="scenes with the default settings")
    parser.add_argument("--episodes", type=int, default=1000, help="episodes of each setup of the swarm alone")
    parser.add_argument("--setups", nargs="+", type=setup, default=SWARM_SETUPS, help="of the swarm: 25x8 ...")
    parser.add_argument("--world", nargs="+", type=setting, default=[], help="of the swarm: orca_radius_m=0.16 ...")
    parser.add_argument("--processes", type=int, default=os.cpu_count(), help="1: all in this one")
    return parser.parse_args(argv)


def setup(text: str) -> tuple[int, int]:
    """(robots, groups) of a setup such as 25x8."""
    robots, groups = text.split("x")
    return int(robots), int(groups)


def setting(text: str) -> tuple[str, Any]:
    """Name and value of a field of WorldConfig, given as name=value."""
    name, value = text.split("=")
    return name, json.loads(value)


@contextmanager
def runner(processes: int) -> Iterator[Run]:
    """Function that calls another with each of several tuples of arguments, in this many processes."""
    if processes == 1:
        yield lambda function, calls: [function(*call) for call in calls]
        return
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        yield lambda function, calls: list(pool.map(function, *zip(*calls, strict=True)))


def parts(count: int, size: int) -> list[range]:
    """0 … count - 1 in pieces of `size`."""
    return [range(first, min(first + size, count)) for first in range(0, count, size)]


def new_table(title: str, *columns: str, names: int = 1) -> Table:
    """A table whose first `names` columns are text."""
    table = Table(title=title, title_justify="left")
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i < names else "right")
    return table


def parity_row(scenes: int, found: Parity) -> list[str]:
    counts = (found.infeasible, found.too_fast, found.ties, found.coincident, found.unexplained)
    share = f"{100 * found.equal / found.robots:.2f} %"
    return [f"{scenes:,}", f"{found.robots:,}", share, f"{found.worst_m_s:.1e}", *(f"{count:,}" for count in counts)]


def matches_rvo2(found: Parity) -> bool:
    return found.unexplained == 0 and found.worst_m_s <= BOUND_M_S


def scenes_section(run: Run, options: argparse.Namespace) -> bool:
    """One step of random scenes; each of the other settings gets a tenth as many."""
    table = new_table("one step of random scenes against RVO2", "settings", "kind", *PARITY_COLUMNS, names=2)
    parities, scenes, broken = [], 0, []
    for name, settings in SETTINGS.items():
        count = -(-options.scenes // (10 if settings else 1) // len(KINDS))
        for kind in KINDS:
            found = run(work.scene_parity, [(kind, numbers, settings) for numbers in parts(count, 200)])
            parities.append(total(parity for parity, _ in found))
            broken += [(name, kind, number) for _, numbers in found for number in numbers]
            table.add_row(name, kind, *parity_row(count, parities[-1]))
            scenes += count
        table.add_section()
    table.add_row("all", "", *parity_row(scenes, total(parities)))
    CONSOLE.print(table)
    for name, kind, number in broken[:10]:
        CONSOLE.print(f"unexplained: numbered_scene({kind!r}, {number}), settings {name!r}")
    return matches_rvo2(total(parities))


def episodes_section(run: Run, options: argparse.Namespace) -> bool:
    """Steps of whole episodes, from FL-ORCA's states and of worlds without flocking."""
    ok, worlds, scenes = True, 8, 8 * -(-work.WHOLE_STEPS // EVERY_STEPS)
    for title, parity in (
        (f"one step from every {EVERY_STEPS}th state of FL-ORCA episodes against RVO2", work.kernel_parity),
        (f"every {EVERY_STEPS}th step of worlds without flocking against RVO2", work.world_parity),
    ):
        table, parities = new_table(title, "setup", *PARITY_COLUMNS), []
        for robots, groups in EPISODE_SETUPS:
            found = run(parity, [(robots, groups, seeds, EVERY_STEPS) for seeds in parts(worlds, 4)])
            parities.append(total(found))
            table.add_row(f"{robots}r×{groups}g", *parity_row(scenes, parities[-1]))
        CONSOLE.print(table)
        ok &= matches_rvo2(total(parities))
    return ok


def spread_row(errors: np.ndarray) -> list[str]:
    quantiles = np.quantile(errors, [0.5, 0.9, 0.99, 0.999, 1.0])
    return [f"{errors.size:,}", *(f"{value:.1e}" for value in quantiles), f"{100 * (errors > 1e-4).mean():.2f} %"]


def float32_section(run: Run, options: argparse.Namespace) -> bool:
    """float32 against float64, for one step of scenes and for many steps from states of episodes."""
    columns = ("robots", "median", "90 %", "99 %", "99.9 %", "largest", "above 1e-4")
    table, ok = new_table("float32 against float64: velocity after one step, m/s", "kind", *columns), True
    for kind in KINDS:
        calls = [(kind, numbers) for numbers in parts(-(-options.scenes // 4 // len(KINDS)), 200)]
        errors = np.concatenate(run(work.scene_precision, calls))
        ok &= bool(np.quantile(errors, 0.9) <= NEAR_FLOAT64_M_S)
        table.add_row(kind, *spread_row(errors))
    CONSOLE.print(table)
    title = f"float32 against float64: positions, m, ORCA alone from steps {DRIFT_STARTS} of FL-ORCA episodes"
    table = new_table(title, "setup", "after steps", *columns)
    for robots, groups in DRIFT_SETUPS:
        calls = [(robots, groups, seeds, DRIFT_STARTS) for seeds in parts(16, 2)]
        found = np.concatenate(run(work.episode_precision, calls), axis=1)
        for steps, errors in zip(DRIFT_STEPS, found, strict=True):
            table.add_row(f"{robots}r×{groups}g", str(steps), *spread_row(errors))
    CONSOLE.print(table)
    return ok


def swarm_section(run: Run, options: argparse.Namespace) -> bool:
    """FL-ORCA alone: overlaps, arrivals, segregation over time."""
    title = f"FL-ORCA alone, {work.WHOLE_STEPS} steps an episode; arrived: all groups within R2 of their goals at once"
    table = new_table(title, "setup", *SWARM_COLUMNS)
    shares = new_table("… share of segregated group pairs at step", "setup", *map(str, work.WATCHED_STEPS))
    ok = True
    for robots, groups in options.setups:
        calls = [(robots, groups, seeds, dict(options.world)) for seeds in parts(options.episodes, 25)]
        found = work.joined(run(work.swarm_episodes, calls))
        name, arrived = f"{robots}r×{groups}g", found.arrival_step <= work.WHOLE_STEPS
        table.add_row(
            name,
            f"{options.episodes:,}",
            f"{(found.overlap_steps > 0).sum():,}",
            f"{found.overlap_steps.sum():,}",
            f"{found.nearest_m.min():.4f}",
            f"{found.fastest_m_s.max():.6f}",
            f"{100 * arrived.mean():.1f} %",
            f"{np.median(found.arrival_step[arrived]):.0f}" if arrived.any() else "–",
        )
        shares.add_row(name, *(f"{share:.3f}" for share in found.segregated.mean(axis=0)))
        ok &= bool(
            (found.fastest_m_s <= found.speed_limit_m_s * SPEED_ROUNDING).all() and not found.overlap_steps.any()
        )
    CONSOLE.print(table)
    CONSOLE.print(shares)
    return ok


SECTIONS = {
    "scenes": scenes_section,
    "episodes": episodes_section,
    "float32": float32_section,
    "swarm": swarm_section,
}

if __name__ == "__main__":
    sys.exit(main())
