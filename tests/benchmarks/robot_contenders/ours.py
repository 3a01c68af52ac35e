"""Our vector environment, whose rows are robots, all of them learning; kinds are methods."""

from itertools import cycle
from typing import Any

import numpy as np

from sim_core.envs import SwarmVectorEnv
from tests.benchmarks.robot_contenders.turns import Job, take_turns

GROUPS = {10: 2, 40: 4, 200: 8}
"""Groups, by the robots of a world."""
AGES = 100
"""Steps before the first turn; worlds are then in all parts of their episodes."""
WORLD: dict[str, Any] = {"max_neighbours": 16, "orca_radius_m": 0.18, "robot_radius_m": 0.06, "learners": "1.0"}


def make(job: Job):
    groups = GROUPS[job.robots]
    setup = {"method": job.kind, "robots": job.robots // groups, "groups": groups}
    env = SwarmVectorEnv(job.worlds * job.robots, **setup, **WORLD)
    rows = np.random.default_rng(0).integers(env.single_action_space.n, size=(20, env.num_envs))
    actions = cycle(rows)
    env.reset(seed=0)

    def step() -> int:
        return int(np.count_nonzero(env.step(next(actions))[4]["decided"]))

    for _ in range(AGES):
        step()
    return step


if __name__ == "__main__":
    take_turns(make)
