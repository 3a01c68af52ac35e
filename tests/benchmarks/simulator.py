"""The simulator's yardsticks, in sections: against pyrvo and RVO2 in C++, by pass, by size, by cores, from the start.

All but the section on cores run on one core, with the child processes that they start.
"""

import os
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from tests.benchmarks import simulator_passes, simulator_processes, simulator_rivals, simulator_scaling
from tests.benchmarks.timing import pinned

SECTIONS = ("full", "orca", "passes", "scaling", "cores", "startup")


def main(sections: Sequence[str] | None = None, rvo2: Sequence[Path] = ()) -> None:
    """Prints the tables of `sections` (all by default); `rvo2`: built drivers for the section `orca`."""
    cores = sorted(os.sched_getaffinity(0), reverse=True)
    tables = {
        "full": simulator_rivals.full_table,
        "orca": lambda: simulator_rivals.orca_table(rvo2),
        "passes": simulator_passes.table,
        "scaling": simulator_scaling.table,
        "cores": lambda: simulator_processes.cores_table(cores),
        "startup": simulator_processes.startup_table,
    }
    console = Console(width=140)
    with pinned(cores[0]):
        for section in SECTIONS:
            if sections is None or section in sections:
                console.print(tables[section]())
