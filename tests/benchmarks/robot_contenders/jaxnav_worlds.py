"""JaxMARL's JaxNav, as it comes but for the size of its map, or `lightest`."""

import math

import jax.numpy as jnp
from jaxmarl.environments.jaxnav.jaxnav_env import JaxNav

from tests.benchmarks.robot_contenders.jax_steps import steps_of
from tests.benchmarks.robot_contenders.turns import Job, take_turns


def make(job: Job):
    """The lightest has 12 lidar rays instead of 200, and no obstacles."""
    side = max(11, math.ceil(3 * math.sqrt(job.robots)))  # 11 as it comes, which has room for ten robots
    light = job.kind == "lightest"
    env = JaxNav(
        num_agents=job.robots,
        lidar_num_beams=12 if light else 200,
        map_params={"map_size": (side, side), "fill": 0.0 if light else 0.3},
    )

    def step(key, state, actions):
        by_name = {name: actions[robot] for robot, name in enumerate(env.agents)}
        observations, state, rewards, dones, _ = env.step_env(key, state, by_name)
        return jnp.stack(list(observations.values())), state, jnp.stack(list(rewards.values())), dones["__all__"]

    return steps_of(env.reset, step, job)


if __name__ == "__main__":
    take_turns(make)
