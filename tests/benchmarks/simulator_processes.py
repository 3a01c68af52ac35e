"""The simulator in processes of its own: two at once on two cores, and a fresh one up to its first step."""

import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, closing

from rich.table import Table

from sim_core.config import WorldConfig
from tests.benchmarks.simulator_rivals import NUM_WORLDS, RandomEpisodes
from tests.benchmarks.timing import ratio, spread

ROUNDS = 5
CORES_CONFIG = WorldConfig(robots=10, groups=4)
CORES_S = 1.0
CORES_TARGET = 1.9
WARM_STARTS = 5
COLD_TARGET_S, WARM_TARGET_S = 30.0, 2.0
FIRST_STEP = """
import time
start_s = time.perf_counter()
import gymnasium
import sim_core
env = gymnasium.make(sim_core.ENV_ID, robots=10, groups=2)
env.reset(seed=0)
env.step(0)
print(time.perf_counter() - start_s)
"""


def serve(core, pipe) -> None:
    """Steps for `CORES_S` from each start time that comes through the pipe; answers with robot steps a second."""
    os.sched_setaffinity(0, {core})
    episodes = RandomEpisodes(CORES_CONFIG)
    pipe.send("ready")
    while (start_s := pipe.recv()) is not None:
        time.sleep(max(0.0, start_s - time.perf_counter()))
        steps = 0
        while time.perf_counter() < start_s + CORES_S:
            episodes.step()
            steps += 1
        pipe.send(steps * episodes.robot_steps / (time.perf_counter() - start_s))


def start_process(core, stack: ExitStack):
    """The pipe to a process of its own on `core`; the process ends with the stack."""
    context = multiprocessing.get_context("spawn")
    pipe, theirs = context.Pipe()
    process = context.Process(target=serve, args=(core, theirs), daemon=True)
    process.start()
    theirs.close()
    stack.callback(process.join, 10)
    stack.enter_context(closing(pipe))
    stack.callback(pipe.send, None)
    pipe.recv()
    return pipe


def rate_together(pipes) -> float:
    """Robot steps a second of all processes behind `pipes` over the same time."""
    start_s = time.perf_counter() + 0.05
    for pipe in pipes:
        pipe.send(start_s)
    return sum(pipe.recv() for pipe in pipes)


def cores_table(cores) -> Table | str:
    if len(cores) < 2:
        return "cores: needs a second core\n"
    alone, both = [], []
    with ExitStack() as stack:
        pipes = [start_process(core, stack) for core in cores[:2]]
        for _ in range(ROUNDS):
            alone.append(sum(rate_together([pipe]) for pipe in pipes) / 2)
            both.append(rate_together(pipes))
    table = Table(
        title=f"processes of {NUM_WORLDS} worlds {CORES_CONFIG.setup}, each on its core\n"
        f"million robot steps/s in all, median (lowest … highest) of {ROUNDS}"
    )
    for column in ("one process (mean of the two cores)", "two processes", "ratio", "target"):
        table.add_column(column, justify="right")
    texts = (spread([rate / 1e6 for rate in rates]).text(2) for rates in (alone, both))
    table.add_row(*texts, ratio(both, alone).text(2), f"≥ {CORES_TARGET:g}")
    return table


def first_step_s(cache: str) -> float:
    """Seconds from the import to the end of the first step, in a fresh interpreter."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
    done = subprocess.run([sys.executable, "-c", FIRST_STEP], env=environment, check=True, capture_output=True)
    return float(done.stdout)


def startup_table() -> Table:
    with tempfile.TemporaryDirectory() as cache:
        cold = first_step_s(cache)
        warm = [first_step_s(cache) for _ in range(WARM_STARTS)]
    table = Table(
        title="from `import sim_core` to the first env.step",
        caption=f"compiled before: median of {WARM_STARTS}",
    )
    for column in ("kernels", "seconds", "target"):
        table.add_column(column, justify="right")
    table.add_row("to compile", f"{cold:.1f}", f"< {COLD_TARGET_S:g}")
    table.add_row("compiled before", spread(warm).text(2), f"< {WARM_TARGET_S:g}")
    return table
