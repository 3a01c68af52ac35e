"""VMAS's scenarios; kinds are their names."""

import torch
import vmas

from tests.benchmarks.robot_contenders.turns import Job, take_turns


def settings(job: Job) -> dict[str, float]:
    """What gives so many robots room to start; both scenarios are made for few."""
    if job.kind == "flocking":
        return {"min_dist_between_entities": 0.15 if job.robots <= 40 else 0.02}
    side_m = 0.5 * job.robots**0.5
    return {"world_spawning_x": side_m, "world_spawning_y": side_m}


def make(job: Job):
    torch.set_num_threads(1)
    env = vmas.make_env(
        job.kind, job.worlds, device="cpu", continuous_actions=False, seed=0, n_agents=job.robots, **settings(job)
    )
    env.reset()
    actions = list(torch.randint(5, (job.robots, job.worlds), generator=torch.Generator().manual_seed(0)))

    def step() -> int:
        env.step(actions)
        return job.robots * job.worlds

    return step


if __name__ == "__main__":
    take_turns(make)
