"""CAMAR's `random_grid`, as it comes or `lightest`."""

import math

from camar import camar_v0

from tests.benchmarks.robot_contenders.jax_steps import steps_of
from tests.benchmarks.robot_contenders.turns import Job, take_turns


def make(job: Job):
    """The lightest has no obstacles, one physics step a step, and the fewest cells that hold starts and goals."""
    if job.kind == "lightest":
        cells = math.ceil(math.sqrt(2 * job.robots))
        grid = {"obstacle_density": 0.0, "grain_factor": 2, "num_rows": cells, "num_cols": cells}
        env = camar_v0(map_kwargs={"num_agents": job.robots, **grid}, frameskip=0)
    else:
        env = camar_v0(map_kwargs={"num_agents": job.robots})
    return steps_of(env.reset, env.step, job)


if __name__ == "__main__":
    take_turns(make)
