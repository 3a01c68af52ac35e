"""The Python side of `rvo2_driver`: the reference RVO2 in C++, kept as a child process."""

import subprocess
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sim_core.worlds import WorldBatch


class Run(NamedTuple):
    """What RVO2 did in one `run`: `seconds` are those inside doStep alone."""

    seconds: float
    robot_steps: int
    mean_neighbours: float


class Rvo2Driver:
    """A driver process that holds the start scene of a batch of worlds; it ends with the `with` block.

    Args:
      path: the built program.
      worlds: freshly reset worlds, whose setup, positions and goals the driver copies.
    """

    def __init__(self, path: Path, worlds: WorldBatch):
        self._process = subprocess.Popen([path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        config = worlds.config
        settings = (config.time_step_s, config.neighbour_range_m, config.max_neighbours, config.orca_horizon_s)
        self._write(np.array([*settings, config.orca_radius_m, config.max_speed_m_s]))
        self._write(np.array([worlds.num_worlds, config.robots, config.groups]))
        self._write(worlds.positions())
        self._write(worlds.goals())

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._process.stdin.close()
        self._process.wait(timeout=10)
        self._process.stdout.close()

    def run(self, episodes: int, steps: int) -> Run:
        """Runs all worlds from their starts, every robot heading for its goal."""
        seconds, robot_steps, mean_neighbours = self._ask(f"run {episodes} {steps}").split()
        return Run(float(seconds), int(robot_steps), float(mean_neighbours))

    def velocities(self, position, velocity, preferred):
        """New velocities `[robots, 2]` float32 of one world after one step from these, each `[robots, 2]`."""
        lines = [self._ask(f"once {len(position)}\n" + as_text(np.hstack([position, velocity, preferred])))]
        lines += [self._process.stdout.readline() for _ in range(len(position) - 1)]
        return np.array([line.split() for line in lines], np.float32)

    def _write(self, numbers) -> None:
        self._process.stdin.write(as_text(numbers) + "\n")

    def _ask(self, command: str) -> str:
        print(command, file=self._process.stdin, flush=True)
        answer = self._process.stdout.readline()
        if not answer:
            raise RuntimeError(f"{self._process.args[0]} has ended with status {self._process.wait()}")
        return answer


def as_text(numbers) -> str:
    """Numbers with the 9 digits that tell all float32 apart."""
    return " ".join(f"{number:.9g}" for number in np.ravel(numbers))
