"""`make soak`: trains at full speed for hours and looks whether memory, handles, processes and references stay flat."""

import argparse
import csv
import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import NamedTuple

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402
import psutil  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402
from scipy import stats  # noqa: E402

from deploy.cli import main as shoal  # noqa: E402
from tests.benchmarks.processes import by_kind  # noqa: E402

FOREVER = 10**12
"""Env steps that no soak comes to."""
FLAT_SHARE_PER_H = 0.01
"""Growth of memory an hour that counts as flat, of what there is after the first quarter; or FLAT_MB_PER_H."""
FLAT_MB_PER_H = 2.0
LEFT_S = 30.0
"""What the run started must have ended so long after it."""
UNDER_WAY = ("references", "objects in the store")
"""Kinds that are no processes: their number goes up and down with what is under way at a look."""
LAST = 12
"""Looks at the end in one of which a count that had risen is down again, unless it leaks: gRPC closes what is idle."""
STORE = "num local plasma objects: "
"""The line of the raylet's own report with the objects in the node's store."""


class Usage(NamedTuple):
    """What all processes of a kind hold at a time."""

    time_s: float
    kind: str
    processes: int
    megabytes: float
    handles: int
    threads: int


def usage(time_s: float) -> list[Usage]:
    """All kinds of processes of this run, this one (the driver) included."""
    return [
        Usage(time_s, kind, int(count), float(own), int(handles), int(threads))
        for kind, (count, own, handles, threads) in by_kind(_held).items()
    ]


def _held(process: psutil.Process) -> tuple[float, ...]:
    return 1, process.memory_full_info().uss / 1e6, process.num_fds(), process.num_threads()


def references() -> tuple[int, int]:
    """(references to objects that the driver holds, objects in the node's store)."""
    from ray._private import worker

    held = len(worker.global_worker.core_worker.get_all_reference_counts())
    report = Path(worker.global_worker.node.get_session_dir_path()) / "logs" / "debug_state.txt"
    lines = [line for line in report.read_text().splitlines() if STORE in line]
    return held, int(lines[0].split(STORE)[1]) if lines else 0


class Sampler(threading.Thread):
    """Looks every so often, and ends the run by SIGTERM when its time is over."""

    def __init__(self, seconds: float, every_s: float, out: Path) -> None:
        super().__init__(daemon=True)
        self._seconds, self._every_s, self._out = seconds, every_s, out
        self.samples: list[Usage] = []

    def run(self) -> None:
        try:
            while not getattr(sys.modules.get("ray"), "is_initialized", bool)():
                time.sleep(1)  # never imported here: the run sets first who may speak to its Ray
            self._look()
        finally:
            os.kill(os.getpid(), signal.SIGTERM)

    def _look(self) -> None:
        start_s = time.monotonic()
        with self._out.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(Usage._fields)
            while (now_s := time.monotonic() - start_s) < self._seconds:
                held, stored = references()
                counted = zip(UNDER_WAY, (held, stored), strict=True)
                found = [*usage(now_s), *(Usage(now_s, kind, count, 0.0, 0, 0) for kind, count in counted)]
                self.samples += found
                writer.writerows(found)
                file.flush()
                time.sleep(self._every_s)


def growth(series: list[Usage], name: str) -> tuple[float, float, float]:
    """Growth of a column an hour (Theil-Sen's slope) with the 95 % interval."""
    hours = [sample.time_s / 3600 for sample in series]
    found = stats.theilslopes([getattr(sample, name) for sample in series], hours, 0.95)
    return float(found.slope), float(found.low_slope), float(found.high_slope)


def row(kind: str, series: list[Usage], quarter_s: float) -> tuple[list[str], bool]:
    """(a line of the table, whether all in it is flat), of what followed the first quarter."""
    settled = [sample for sample in series if sample.time_s >= quarter_s]
    early = [sample for sample in settled if sample.time_s < 2 * quarter_s]
    late = [sample for sample in settled if sample.time_s >= 3 * quarter_s]
    if not early or not late:
        return [kind, "comes and goes", *[""] * 5], True
    words, flat = [kind], True
    for name in ("processes", "handles", "threads", "megabytes"):
        before, after = (float(np.median([getattr(sample, name) for sample in part])) for part in (early, late))
        if name == "megabytes":
            slope, low, high = growth(settled, name)
            flat &= low <= max(FLAT_SHARE_PER_H * before, FLAT_MB_PER_H)
            words += [f"{before:,.1f} → {after:,.1f}", f"{slope:+.2f} ({low:+.2f} … {high:+.2f})"]
        else:
            varies = name == "threads" or kind in UNDER_WAY  # gRPC's pools of threads breathe
            given_back = min(getattr(sample, name) for sample in settled[-LAST:]) <= before
            flat &= after - before < 1 or given_back or (varies and growth(settled, name)[1] <= 0)
            words.append(f"{before:g} → {after:g}")
    return [*words, "yes" if flat else "NO"], flat


def report(samples: list[Usage], console: Console) -> bool:
    """Prints the table; returns whether all is flat."""
    seconds = max(sample.time_s for sample in samples)
    table = Table(title=f"{seconds / 3600:.2f} h of training: medians of the second → the last quarter")
    for column in ("kind", "number", "handles", "threads", "own memory, MB", "growth, MB/h", "flat"):
        table.add_column(column, justify="left" if column == "kind" else "right")
    flat = True
    for kind in sorted({sample.kind for sample in samples}):
        words, good = row(kind, [sample for sample in samples if sample.kind == kind], seconds / 4)
        table.add_row(*words)
        flat &= good
    console.print(table)
    return flat


def left_over() -> list[psutil.Process]:
    """Processes of the run that outlive it."""
    end_s = time.monotonic() + LEFT_S
    while (left := psutil.Process().children(recursive=True)) and time.monotonic() < end_s:
        time.sleep(0.5)
    return left


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.soak", description=__doc__)
    parser.add_argument("--hours", type=float, default=2.0, help="how long to train")
    parser.add_argument("--every-s", type=float, default=20.0, help="seconds between two looks")
    parser.add_argument("--out", type=Path, default=Path("runs/soak"), help="a new folder for the run and soak.csv")
    options, flags = parser.parse_known_args(arguments)
    options.out.mkdir(parents=True)
    sampler = Sampler(3600 * options.hours, options.every_s, options.out / "soak.csv")
    sampler.start()
    place = ["--name", "soak", "--runs-dir", str(options.out), "--total-env-steps", str(FOREVER)]
    code = shoal(["train", *place, *flags])
    console = Console(width=140)
    flat = report(sampler.samples, console)
    left = left_over()
    console.print(f"`shoal train` ended with exit code {code}; {len(left)} processes left over", highlight=False)
    return 0 if flat and not left else 1


if __name__ == "__main__":
    sys.exit(main())
