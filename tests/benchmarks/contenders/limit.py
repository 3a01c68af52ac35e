"""What the machine could do if nothing but simulation and updates took time: our bare simulator and bare learner.

Each is measured by itself, on one core, while the others are idle. The simulator may have as many cores as it likes,
the learner no more than one.
"""

import dataclasses
import os

from learner.config import RunConfig
from tests.benchmarks.contest import Finding, Heat, compete
from tests.benchmarks.service import learner_work, simulator_work
from tests.benchmarks.timing import rates, spread

ROUNDS = 5


def most_updates(config: RunConfig, env_steps_per_s: float, updates_per_s: float, cores: int) -> float:
    """Updates a second of `cores` cores of which each makes so many env steps or so many updates a second."""
    env_steps = config.batch_size / config.samples_per_insert  # for each update
    seconds = env_steps / env_steps_per_s + 1 / updates_per_s
    return min(updates_per_s, cores / seconds)


def measure(heat: Heat) -> Finding:
    config = dataclasses.replace(heat.config, envs_per_worker=heat.envs)
    works = {"simulator": simulator_work(config, 2), "learner": learner_work(config)}
    bare = {name: spread(rates({name: work}, ROUNDS)[name]).median for name, work in works.items()}
    updates = most_updates(config, bare["simulator"], bare["learner"], len(os.sched_getaffinity(0)))
    return Finding(updates * config.batch_size / config.samples_per_insert, updates, 0.0, None, 0, None)


if __name__ == "__main__":
    compete(measure)
