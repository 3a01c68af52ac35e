"""How long a user waits: from a command to its first result, from the end of a training to its summary, and for a run
whose driver was killed.

Every command runs in a process of its own, in turn with the import of numpy, the unit that cancels the machine's load
out. With `--against`, each also runs from another checkout, in the same round.
"""

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import psutil
from rich.console import Console
from rich.table import Table

import deploy
from learner.file_names import CHECKPOINTS, IDENTITY, JOURNAL
from learner.tracking.journal import read_rows
from tests.benchmarks.processes import IDLE, kind_of
from tests.benchmarks.timing import ratio, spread

ROUNDS = 3
HERE = Path(deploy.__file__).parents[1]
UNIT = "import numpy"
HELP, ENVIRONMENT = "shoal --help", "import sim_core, make, reset"
RESET = "import gymnasium, sim_core; gymnasium.make(sim_core.ENV_ID, robots=10, groups=2).reset(seed=0)"
ENGINES = {"ray": "over Ray", "process": "in one process"}
TRAINING = ["--robots", "10", "--groups", "2", "--total-env-steps", "100000", "--log-every-env-steps", "1"]
"""A row of metrics a block, so that the first row tells when the first block of transitions was stored."""
RECOVERED = "driver killed to the next update, --supervise"
BEGUN, STORED, ENDED = "run in MLflow", "first stored transition", "end of training to summary"
TARGETS_S = {
    HELP: 0.4,
    RECOVERED: 20.0,
    ENVIRONMENT: 1.5,
    f"train over Ray: {STORED}": 5.0,
    f"train in one process: {STORED}": 2.5,
    f"train over Ray: {ENDED}": 3.0,
    f"train in one process: {ENDED}": 3.0,
    f"train over Ray, cold kernels: {STORED}": 30.0,
    f"train in one process, cold kernels: {STORED}": 30.0,
}
ENDLESS = ["--total-env-steps", "100000000", "--log-every-env-steps", "1", "--checkpoint-every-env-steps", "50000"]
POLL_S, CPU_POLL_S = 0.02, 0.2

CpuSeconds = Counter[str]
"""CPU seconds by kind of process."""


class Training(NamedTuple):
    """Seconds from the command to each phase, and CPU seconds until the first stored transition and in all."""

    seconds: dict[str, float]
    stored_cpu_s: CpuSeconds
    cpu_s: CpuSeconds


class CpuMeter:
    """CPU seconds of a command's processes, also of those that have ended.

    Args:
      driver: id of the process of the command.
    """

    def __init__(self, driver: int) -> None:
        self._driver = psutil.Process(driver)
        self._found: dict[psutil.Process, tuple[str, float]] = {}

    def look(self) -> None:
        """Takes in what the processes have used so far."""
        with suppress(psutil.NoSuchProcess):
            for process in [self._driver, *self._driver.children(recursive=True)]:
                with suppress(psutil.NoSuchProcess):
                    kind = "driver" if process == self._driver else kind_of(process)
                    if kind == IDLE and process in self._found:
                        kind, _ = self._found[process]  # what it did before it became idle
                    self._found[process] = kind, sum(process.cpu_times()[:2])

    def by_kind(self) -> CpuSeconds:
        """CPU seconds at the last look of each process."""
        seconds = CpuSeconds()
        for kind, spent_s in self._found.values():
            seconds[kind] += spent_s
        return seconds


def environment(checkout: Path, **more: str) -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONDONTWRITEBYTECODE", *more)}
    return kept | {"PYTHONPATH": str(checkout), "PYTHONUNBUFFERED": "1"} | more


def seconds_of(checkout: Path, *arguments: str) -> float:
    """Seconds of a whole process of Python."""
    start_s = time.perf_counter()
    order = [sys.executable, *arguments]
    here = {"cwd": checkout, "env": environment(checkout)}  # Python looks for modules in the present folder first
    subprocess.run(order, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, **here)
    return time.perf_counter() - start_s


def first_row_s(run: Path) -> float | None:
    """When the first row of metrics was measured, seconds since the epoch; None while there is none."""
    return next((row.time_ms / 1e3 for row in read_rows(run / JOURNAL)), None)


def train(checkout: Path, engine: str, **more: str) -> Training:
    """A whole training, with its evaluation and artifacts.

    Raises:
      RuntimeError: it failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "runs" / "timed"
        order = [sys.executable, "-m", "deploy", "train", "--engine", engine, "--name", run.name, *TRAINING]
        start_s, lines = time.time(), list[tuple[float, str]]()
        child = subprocess.Popen(
            [*order, "--runs-dir", str(run.parent)],
            cwd=checkout,
            env=environment(checkout, **more),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        meter = CpuMeter(child.pid)

        def read() -> None:
            for line in child.stdout or ():
                lines.append((time.time(), line))

        reader = threading.Thread(target=read)
        reader.start()
        while (stored_s := first_row_s(run)) is None and child.poll() is None:
            time.sleep(POLL_S)
        meter.look()
        stored_cpu_s = meter.by_kind()
        while child.poll() is None:
            meter.look()
            time.sleep(CPU_POLL_S)
        reader.join()
        if child.wait() or stored_s is None:
            raise RuntimeError("".join(line for _, line in lines))
        done_s, summary_s = (
            next(at_s for at_s, line in lines if line.startswith(words)) for words in ("training done", "trained")
        )
        begun_s = (run / IDENTITY).stat().st_mtime
        return Training(
            {BEGUN: begun_s - start_s, STORED: stored_s - start_s, ENDED: summary_s - done_s},
            stored_cpu_s,
            meter.by_kind(),
        )


def recover() -> float:
    """Seconds from kill -9 of the driver of a supervised training over Ray to its next update.

    Raises:
      RuntimeError: the training ended.
    """
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "runs" / "timed"
        order = [sys.executable, "-m", "deploy", "train", "--supervise", "--name", run.name, *ENDLESS]
        with (Path(folder) / "log").open("w") as log:
            child = subprocess.Popen(
                [*order, "--runs-dir", str(run.parent)], env=environment(HERE), stdout=log, stderr=log
            )

        def wait() -> None:
            time.sleep(POLL_S)
            if child.poll() is not None:
                raise RuntimeError((Path(folder) / "log").read_text())

        try:
            while not list((run / CHECKPOINTS).glob("step-*[0-9]")):
                wait()
            (driver,) = psutil.Process(child.pid).children()
            driver.kill()
            killed_s, updated_s = time.time(), list[float]()
            while not updated_s:
                wait()
                rows = [row for row in read_rows(run / JOURNAL) if "train/loss" in row.metrics]
                updated_s = [row.time_ms / 1e3 for row in rows if row.time_ms / 1e3 > killed_s]
            return updated_s[0] - killed_s
        finally:
            child.terminate()
            child.wait()


class Findings:
    """Seconds of what is measured, by checkout and name, and CPU seconds of the trainings."""

    def __init__(self) -> None:
        self.seconds: dict[Path, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
        self.stored_cpu_s: dict[Path, dict[str, list[CpuSeconds]]] = defaultdict(lambda: defaultdict(list))
        self.cpu_s: dict[Path, dict[str, list[CpuSeconds]]] = defaultdict(lambda: defaultdict(list))

    def add(self, checkout: Path, how: str, training: Training) -> None:
        for phase, seconds in training.seconds.items():
            self.seconds[checkout][f"train {how}: {phase}"].append(seconds)
        self.stored_cpu_s[checkout][how].append(training.stored_cpu_s)
        self.cpu_s[checkout][how].append(training.cpu_s)

    def measure(self, checkout: Path) -> None:
        """One round."""
        found = self.seconds[checkout]
        found[UNIT].append(seconds_of(checkout, "-c", UNIT))
        found[HELP].append(seconds_of(checkout, "-m", "deploy", "--help"))
        found[ENVIRONMENT].append(seconds_of(checkout, "-c", RESET))
        for engine, how in ENGINES.items():
            self.add(checkout, how, train(checkout, engine))

    def measure_cold(self, checkout: Path) -> None:
        """Once with kernels to compile."""
        for engine, how in ENGINES.items():
            with tempfile.TemporaryDirectory() as folder:
                training = train(checkout, engine, NUMBA_CACHE_DIR=folder)
            self.add(checkout, f"{how}, cold kernels", training)


def time_table(findings: Findings, other: Path | None) -> Table:
    table = Table(title="seconds, median (lowest … highest); load cancels in both ratios")
    for name in ("from the command to", "seconds", f"× {UNIT}", "target, idle", *(("of the other",) if other else ())):
        table.add_column(name, justify="left" if name.startswith("from") else "right")
    ours = findings.seconds[HERE]
    for name, seconds in ours.items():
        unit = ratio(seconds, ours[UNIT]).text(1) if UNIT in ours else ""
        target = f"≤ {TARGETS_S[name]:g}" if name in TARGETS_S else ""
        theirs = findings.seconds[other].get(name) if other else None
        compared = ratio(seconds, theirs).text(2) if theirs else ""
        table.add_row(name, spread(seconds).text(2), unit, target, *([compared] if other else []))
    return table


def cpu_table(title: str, found: dict[Path, dict[str, list[CpuSeconds]]], other: Path | None) -> Table:
    table = Table(title=f"CPU seconds {title}, means")
    table.add_column("training")
    table.add_column("process")
    for name in ("here", *(("the other",) if other else ())):
        table.add_column(name, justify="right")
    checkouts = [HERE, *([other] if other else [])]
    for how in found[HERE]:
        means = [mean_counts(found[checkout][how]) for checkout in checkouts]
        for kind in sorted(set().union(*means), key=lambda kind: -means[0].get(kind, 0.0)):
            table.add_row(how, kind, *(f"{each.get(kind, 0.0):.2f}" for each in means))
        table.add_row(how, "sum", *(f"{sum(each.values()):.2f}" for each in means), end_section=True)
    return table


def mean_counts(counts: list[CpuSeconds]) -> dict[str, float]:
    return {kind: sum(count[kind] for count in counts) / len(counts) for kind in set().union(*counts)}


def main(against: Path | None = None, rounds: int = ROUNDS) -> None:
    checkouts, findings = [HERE, *([against.resolve()] if against else [])], Findings()
    other = checkouts[1] if against else None
    for checkout in checkouts:
        train(checkout, "process")  # compiles the kernels, and Python's modules
    for _ in range(rounds):
        for checkout in checkouts:
            findings.measure(checkout)
        findings.seconds[HERE][RECOVERED].append(recover())
    console, cold = Console(width=120), Findings()
    console.print(time_table(findings, other))
    console.print(cpu_table("until the first stored transition", findings.stored_cpu_s, other))
    console.print(cpu_table("from the command to its end", findings.cpu_s, other))
    for checkout in checkouts:
        cold.measure_cold(checkout)
    console.print(time_table(cold, other))
    console.print(f"load of the machine: {', '.join(f'{load:.1f}' for load in os.getloadavg())} (1, 5, 15 minutes)")


if __name__ == "__main__":
    main()
