"""IR-SIM, of which a process has one world: plain Python."""

import math
import tempfile
from itertools import cycle
from pathlib import Path

import irsim
import numpy as np
import yaml

from tests.benchmarks.robot_contenders.turns import Job, take_turns

RAYS, RANGE_M, RADIUS_M, SPEED_M_S = 12, 3.0, 0.1, 1.0


def scene(robots: int) -> dict[str, object]:
    """Its world file: holonomic discs with a lidar each, in a square that gives every robot 4 m2."""
    side_m = 2 * math.sqrt(robots)
    lidar = {"name": "lidar2d", "range_max": RANGE_M, "angle_range": 2 * math.pi, "number": RAYS}
    discs = {
        "number": robots,
        "distribution": {"name": "random", "range_low": [0, 0, 0], "range_high": [side_m, side_m, 2 * math.pi]},
        "kinematics": {"name": "omni"},
        "shape": {"name": "circle", "radius": RADIUS_M},
        "vel_max": [SPEED_M_S, SPEED_M_S],
        "goal": [side_m / 2, side_m / 2, 0],
        "sensors": [lidar],
    }
    world = {"height": side_m, "width": side_m, "step_time": 0.1, "collision_mode": "unobstructed"}
    return {"world": world, "robot": [discs]}


def make(job: Job):
    if job.worlds != 1:
        raise ValueError(f"IR-SIM has one world a process, not {job.worlds}")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "world.yaml"
        file.write_text(yaml.safe_dump(scene(job.robots)), "utf-8")
        env = irsim.make(str(file), headless=True, log_level="ERROR", seed=0)
    ids = list(range(job.robots))
    velocities = np.random.default_rng(0).uniform(-SPEED_M_S, SPEED_M_S, (20, job.robots, 2, 1))
    actions = cycle(map(list, velocities))

    def step() -> int:
        env.step(next(actions), ids)
        for robot in ids:
            env.get_lidar_scan(robot)
        return job.robots

    return step


if __name__ == "__main__":
    take_turns(make)
