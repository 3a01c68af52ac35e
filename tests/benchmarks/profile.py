"""Where the CPU time of an update goes in a training over Ray: py-spy's samples of its processes, by what they are for.

An update stands for all that belongs to it: the env steps whose transitions it samples, and its share of the messages.
"""

import dataclasses
import subprocess
import sys
import sysconfig
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

import psutil
from rich.console import Console
from rich.table import Table

from learner.config import RunConfig
from tests.benchmarks.processes import processes_of_the_run
from tests.benchmarks.service import SAMPLES_PER_INSERT, learner_work, limited_configs
from tests.benchmarks.timing import spread, stopwatch, timed_rates
from tests.benchmarks.whole_service import ENDLESS, WARM_S, whole_service
from tests.checkpointing import Silent

SECONDS, RATE_HZ = 30, 100
BARE_ROUNDS = 5
KERNELS = "sim_core/jit.py"
SPY = Path(sysconfig.get_path("scripts")) / "py-spy"
PARTS = ("driver", "rollout worker", "learner")
RAY = "Ray"
Costs = dict[tuple[str, str], float]
"""Of each process and work, CPU time in microseconds an update."""
Samples = dict[int, Counter[str]]
"""Of each thread, by its id, how often it was seen at what."""
WORK = (
    ("simulation", ("sim_core/", "gymnasium/", "actors/rollout/entry_point_env.py")),
    ("policy", ("actors/policy/", "actors/rollout/exploration.py")),
    (
        "updates",
        (
            "learner/update/compiled_updates.py",
            "learner/update/learner.py",
            "learner/update/updates.py",
            "learner/update/double_dqn.py",
        ),
    ),
    ("replay", ("actors/replay/", "actors/service/packing.py", "actors/storage/ring_snapshot.py")),
    (
        "transitions and blocks",
        (
            "actors/rollout/worker.py",
            "actors/rollout/nstep.py",
            "actors/rollout/step_kernels.py",
            "actors/rollout/vector_env.py",
        ),
    ),
    ("training loop", ("learner/", "actors/", "tests/")),
    (RAY, ("ray/", "<frozen")),
)
"""What a sample is for, by the file of its innermost frame that is named here."""


def work_of(stack: str) -> str:
    """What a stack is for: its frames, `function (file:line)` from the outermost in, are joined by `;`."""
    for frame in reversed(stack.split(";")):
        path = frame.rpartition("(")[2]
        if path.startswith(KERNELS):
            continue  # whoever calls a kernel says what for
        for work, files in WORK:
            if path.startswith(files):
                return work
    return RAY  # what Ray's threads run of the standard library


def sorted_samples(lines: Iterable[str]) -> Samples:
    """Samples of each thread by what they are for.

    Args:
      lines: py-spy's raw format: a stack, its thread first, and how often it was seen.
    """
    found: Samples = {}
    for line in lines:
        stack, _, count = line.rpartition(" ")
        thread = int(stack.partition("(")[2].partition(")")[0])
        found.setdefault(thread, Counter())[work_of(stack)] += int(count)
    return found


def spied(processes: dict[str, psutil.Process], seconds: int) -> dict[str, Samples]:
    """Samples of processes, looked at together for so many seconds.

    Raises:
      RuntimeError: one cannot be looked at.
    """
    with tempfile.TemporaryDirectory() as folder:
        spies: dict[str, tuple[Path, subprocess.Popen[str]]] = {}
        for kind, process in processes.items():
            out = Path(folder) / str(process.pid)
            order = [SPY, "record", "--nonblocking", "--threads", "-f", "raw", "-o", out, "-r", RATE_HZ, "-d", seconds]
            text = list(map(str, [*order, "-p", process.pid]))
            spies[kind] = out, subprocess.Popen(text, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        found = {}
        for kind, (out, spy) in spies.items():
            _, trouble = spy.communicate()
            if spy.returncode or not out.exists():
                raise RuntimeError(f"py-spy cannot look at the {kind}, as most systems let root alone: {trouble}")
            found[kind] = sorted_samples(out.read_text("utf-8").splitlines())
    return found


def thread_seconds() -> dict[str, dict[int, float]]:
    """CPU seconds so far of each thread of the run, by kind of process."""
    found: dict[str, dict[int, float]] = {}
    for kind, process in processes_of_the_run():
        with suppress(psutil.NoSuchProcess):
            threads = {thread.id: thread.user_time + thread.system_time for thread in process.threads()}
            found.setdefault(kind, {}).update(threads)
    return found


def spent_on(thread_s: dict[int, float], samples: Samples) -> Counter[str]:
    """CPU seconds of processes of a kind by what they were for; threads that no sample shows are Ray's own."""
    found: Counter[str] = Counter()
    for thread, spent_s in thread_s.items():
        seen = samples.get(thread, Counter({RAY: 1}))
        for work, count in seen.items():
            found[work] += spent_s * count / seen.total()
    return found


class Spy(threading.Thread):
    """Looks at the run's processes once it is steady.

    Args:
      updates: tells how many the run has made.
    """

    def __init__(self, updates: Callable[[], int]) -> None:
        super().__init__(daemon=True)
        self._updates = updates
        self.costs: Costs = {}
        self.trouble = ""

    def run(self) -> None:
        time.sleep(WARM_S)
        processes = {kind: process for kind, process in processes_of_the_run() if kind in PARTS}
        before, made = thread_seconds(), self._updates()
        try:
            samples = spied(processes, SECONDS)
        except RuntimeError as error:
            self.trouble = str(error)
            return
        spent: Counter[tuple[str, str]] = Counter()
        now, made = thread_seconds(), self._updates() - made
        for kind, after in now.items():
            earlier = before.get(kind, {})
            thread_s = {thread: after[thread] - earlier.get(thread, 0.0) for thread in after}
            spent.update({(kind, work): value for work, value in spent_on(thread_s, samples.get(kind, {})).items()})
        self.costs = {part: 1e6 * value / made for part, value in spent.most_common()}


def costs_of(config: RunConfig) -> Costs:
    """CPU time of an update, by process and work, the most first."""
    spies: list[Spy] = []
    with whole_service(config) as make_loop:

        def stop() -> bool:
            if loop.updates and not spies:
                spies.append(Spy(lambda: loop.updates))
                spies[0].start()
            return bool(spies) and not spies[0].is_alive()

        loop = make_loop(Silent(), stop)
        loop.run()
    if spies[0].trouble:
        sys.exit(spies[0].trouble)
    return spies[0].costs


def main() -> None:
    swarm = {
        f"10r×2g, {samples:g} samples per insert": dataclasses.replace(RunConfig(**ENDLESS), samples_per_insert=samples)
        for samples in SAMPLES_PER_INSERT
    }
    configs = swarm | {name: config for name, config in limited_configs().items() if name.startswith("CartPole")}
    found = [costs_of(config) for config in configs.values()]
    table = Table(title="CPU time of an update and of all that belongs to it, microseconds")
    for column in ("process", "what it does"):
        table.add_column(column)
    for name in configs:
        table.add_column(name, justify="right")
    parts = list(dict.fromkeys(part for costs in found for part in costs))
    for part in parts:
        spent = [costs.get(part, 0.0) for costs in found]
        if any(value >= 0.005 * sum(costs.values()) for value, costs in zip(spent, found, strict=True)):
            table.add_row(*part, *(f"{value:.1f}" for value in spent))
    table.add_row("all", "", *(f"{sum(costs.values()):.1f}" for costs in found))
    works = {name: stopwatch(learner_work(config), time.process_time) for name, config in configs.items()}
    bare = [1e6 / spread(rates).median for rates in timed_rates(works, BARE_ROUNDS).values()]
    table.add_row("bare learner", "updates", *(f"{value:.1f}" for value in bare))
    Console(width=160).print(table)
