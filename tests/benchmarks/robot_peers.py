"""`make bench-robots`: steps of learning robots a second, beside peers that simulate many robots on a CPU.

All robots of a world learn and act at random, on one core; what counts for shoal are decisions that were taken, since a
robot whose episode has ended waits for its world. The peers have no end of an episode here. Every contender runs in a
process of its own, tries several numbers of worlds and keeps the fastest; then all take turns.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from tests.benchmarks.robot_contenders.turns import MARK, Job
from tests.benchmarks.timing import Timed, pinned, ratio, spread, timed_rates

ROOT = Path(__file__).parents[2]
METHODS = ("sensor", "in", "out")
ROBOTS = (10, 40, 200)
"""Of a world."""
QUIET = {"PYTHONWARNINGS": "ignore", "JAX_PLATFORMS": "cpu", "OMP_NUM_THREADS": "1"}


class Contender(NamedTuple):
    """Who takes part.

    Attributes:
      module: of `robot_contenders`.
      kind: of those that the module has.
      needs: the module that its interpreter must find, and the package that has it.
      simulates: what, in a few words.
      batches: robots in all worlds of a process; the fastest is taken. Some gain by many, some outgrow the cache.
    """

    name: str
    module: str
    kind: str
    needs: tuple[str, str]
    simulates: str
    batches: tuple[int, ...]

    def worlds(self, robots: int) -> list[int]:
        """Numbers of worlds to try, of so many robots each."""
        return list(dict.fromkeys(max(1, batch // robots) for batch in self.batches))


OURS = tuple(
    Contender(
        f"shoal, {method}",
        "ours",
        method,
        ("sim_core", "shoal"),
        "velocities; FL-ORCA drives every robot that has ended; the method's observation, reward and outcome",
        (2_560, 40_960),
    )
    for method in METHODS
)
VMAS = (
    Contender(
        "VMAS flocking",
        "vmas_worlds",
        "flocking",
        ("vmas", "vmas"),
        "forces, 5 substeps; spheres push each other off; 5 obstacles, which 12 lidar rays a robot see; no avoidance",
        (10_240, 40_960),
    ),
    Contender(
        "VMAS navigation",
        "vmas_worlds",
        "navigation",
        ("vmas", "vmas"),
        "forces, 2 substeps; spheres push each other off; a goal each; 12 lidar rays that see robots; no avoidance",
        (10_240, 40_960),
    ),
)
OTHERS = (
    Contender(
        "CAMAR",
        "camar_worlds",
        "as it comes",
        ("camar", "camar"),
        "forces, 3 substeps; discs push each other off; 800 circles as obstacles; a goal each; the 3 nearest objects "
        "within 0.3 m; no avoidance",
        (160, 2_560),
    ),
    Contender(
        "CAMAR, lightest",
        "camar_worlds",
        "lightest",
        ("camar", "camar"),
        "the same with one substep, without obstacles, in the smallest grid that holds starts and goals",
        (160, 2_560),
    ),
    Contender(
        "JaxNav",
        "jaxnav_worlds",
        "as it comes",
        ("jaxmarl", "jaxmarl"),
        "unicycles with limits of acceleration; collisions end a robot's episode; walls on a grid; a goal each; 200 "
        "lidar rays of 6 m; no avoidance",
        (160, 640),
    ),
    Contender(
        "JaxNav, lightest",
        "jaxnav_worlds",
        "lightest",
        ("jaxmarl", "jaxmarl"),
        "the same with 12 lidar rays, without inner walls",
        (160, 640),
    ),
    Contender(
        "IR-SIM",
        "irsim_world",
        "as it comes",
        ("irsim", "ir-sim"),
        "velocities of holonomic discs; collisions are told and stop nobody; 12 lidar rays of 3 m a robot; RVO for "
        "robots that do not learn, so none here; one world a process",
        (1,),
    ),
)


class Running:
    """A contender's process, which takes a turn when called.

    Args:
      contender: who.
      python: its interpreter.
      path: a folder that its imports may come from, None for those of its interpreter alone.
      job: what it simulates.

    Raises:
      RuntimeError: when called, if the process has ended.
    """

    def __init__(self, contender: Contender, python: str, path: Path | None, job: Job) -> None:
        self.worlds = job.worlds
        module = f"tests.benchmarks.robot_contenders.{contender.module}"
        words = [python, "-m", module, job.kind, str(job.robots), str(job.worlds)]
        places = os.pathsep.join(str(place) for place in (ROOT, path) if place is not None)
        self._errors = tempfile.TemporaryFile("w+")
        self._process = subprocess.Popen(
            words,
            cwd=ROOT,
            env={**os.environ, **QUIET, "PYTHONPATH": places},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
        )

    def __call__(self) -> Timed:
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            self._process.stdin.write("\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            pass  # what it printed says why
        for line in self._process.stdout:
            if line.startswith(f"{MARK} "):
                _, robot_steps, seconds = line.split()
                return Timed(int(robot_steps), float(seconds))
        self._process.wait()
        self._errors.seek(0)
        raise RuntimeError(f"{self._process.args} failed:\n{self._errors.read()[-2000:]}")

    def __enter__(self) -> "Running":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()  # its input is then at its end, and so is it
        self._errors.close()


class Field:
    """Who takes part, and what each needs.

    Args:
      options: those of the command line.
      console: where it is told who is left out.
    """

    def __init__(self, options: argparse.Namespace, console: Console) -> None:
        self._options = options
        self.contenders = [*OURS]
        for contender in (*VMAS, *OTHERS):
            if missing := self._missing(contender):
                console.print(f"{contender.name}: {missing}, left out")
            else:
                self.contenders.append(contender)

    def run(self, contender: Contender, robots: int, worlds: int) -> Running:
        ours = contender in (*OURS, *VMAS)
        python = sys.executable if ours else str(self._options.peers)
        path = self._options.vmas if contender in VMAS else None
        return Running(contender, python, path, Job(contender.kind, robots, worlds))

    def fastest(self, contender: Contender, robots: int) -> int:
        """The number of worlds that gives it most robot steps a second."""
        worlds_to_try = contender.worlds(robots)
        if len(worlds_to_try) == 1:
            return worlds_to_try[0]
        found = {}
        for worlds in worlds_to_try:
            with self.run(contender, robots, worlds) as running:
                turn = running()
            found[worlds] = turn.units / turn.seconds
        return max(found, key=lambda worlds: found[worlds])

    def _missing(self, contender: Contender) -> str:
        module, package = contender.needs
        if contender in VMAS:
            folder = self._options.vmas
            return "" if folder is not None and (folder / module).is_dir() else "no --vmas FOLDER with it"
        if self._options.peers is None:
            return f"no --peers PYTHON with {package}"
        code = f"import importlib.util as u; raise SystemExit(u.find_spec({module!r}) is None)"
        done = subprocess.run([self._options.peers, "-c", code], check=False)
        return f"{self._options.peers} has no {package}" if done.returncode else ""


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.robot_peers", description=__doc__)
    parser.add_argument("--vmas", type=Path, metavar="FOLDER", help="that VMAS was installed to (pip --target)")
    parser.add_argument("--peers", type=Path, metavar="PYTHON", help="an interpreter with camar, jaxmarl and ir-sim")
    parser.add_argument("--robots", type=int, nargs="+", choices=ROBOTS, default=list(ROBOTS), help="of a world")
    parser.add_argument("--rounds", type=int, default=5, help="of every measurement")
    return parser.parse_args(arguments)


def add_rows(result: Table, field: Field, robots: int, rounds: int) -> None:
    """Robot steps a second of all contenders, for one number of robots."""
    with ExitStack() as stack:
        running = {
            contender.name: stack.enter_context(field.run(contender, robots, field.fastest(contender, robots)))
            for contender in field.contenders
        }
        rates = timed_rates(running, rounds)
    ours = [rates[contender.name] for contender in OURS]
    for contender in field.contenders:
        measured = rates[contender.name]
        steps = spread(measured)
        against = "" if contender in OURS else " … ".join(f"{ratio(mine, measured).median:,.0f}" for mine in ours)
        worlds = f"{running[contender.name].worlds}"
        row = (f"{robots}", contender.name, worlds, f"{steps.median / robots:,.0f}", steps.text(), against)
        result.add_row(*row)
    result.add_section()


def main(arguments: list[str] | None = None) -> int:
    options = parse(arguments)
    console = Console(width=140)
    field = Field(options, console)
    result = Table(title=f"steps of observed, learning robots on one core, median (range) of {options.rounds}")
    for name in ("robots", "contender", "worlds", "env steps/s", "robot steps/s", "shoal / it"):
        result.add_column(name, justify="left" if name == "contender" else "right")
    with pinned(max(os.sched_getaffinity(0))):
        for robots in options.robots:
            add_rows(result, field, robots, options.rounds)
    console.print(result)
    console.print(f"shoal / it: {', '.join(contender.kind for contender in OURS)}")
    for contender in (OURS[0], *field.contenders[len(OURS) :]):
        console.print(f"{contender.name}: {contender.simulates}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
