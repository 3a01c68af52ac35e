"""What the contenders of `tests.benchmarks.robot_peers` have in common: who they are, and how a turn is asked for.

A contender is a module of this folder that runs in a process, and where need be an interpreter, of its own:
`python -m tests.benchmarks.robot_contenders.camar_worlds KIND ROBOTS WORLDS`. For every line on its standard input it
steps its worlds for `TURN_S` of CPU time and prints how many robot steps it took in how many seconds. Nothing but the
standard library is imported here, so that every interpreter can run it.
"""

import sys
import time
from collections.abc import Callable
from typing import NamedTuple

TURN_S = 0.5
WARM_UP = 3
"""Steps before the first turn; JAX compiles in the first two."""
MARK = "turn"
"""First word of a contender's lines; libraries print others."""


class Job(NamedTuple):
    """What a contender is asked to simulate."""

    kind: str
    robots: int
    worlds: int


def take_turns(make: Callable[[Job], Callable[[], int]]) -> None:
    """Runs a contender as the program that this process is.

    Args:
      make: gives a function that steps all worlds once, with random actions of all robots, and returns how many robots
        acted and were observed.
    """
    kind, robots, worlds = sys.argv[1:]
    step = make(Job(kind, int(robots), int(worlds)))
    for _ in range(WARM_UP):
        step()
    for _ in sys.stdin:
        robot_steps, start_s = 0, time.process_time()  # of this process alone: others may use the core, too
        while (took_s := time.process_time() - start_s) < TURN_S:
            robot_steps += step()
        print(MARK, robot_steps, took_s, flush=True)
