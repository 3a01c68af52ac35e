"""What the machine could do if nothing but simulation and updates took time: our bare simulator and bare learner.

Each is measured by itself, on one core, while the others are idle. The simulator may have as many cores as it likes,
the learner no more than one.
"""

import dataclasses
import os

from tests.benchmarks.contest import Finding, Heat, compete
from tests.benchmarks.service import learner_work, most_updates, simulator_work
from tests.benchmarks.timing import rates, spread

ROUNDS = 5


def measure(heat: Heat) -> Finding:
    config = dataclasses.replace(heat.config, envs_per_worker=heat.envs)
    works = {"simulator": simulator_work(config, 2), "learner": learner_work(config)}
    bare = {name: spread(rates({name: work}, ROUNDS)[name]).median for name, work in works.items()}
    updates = most_updates(config, bare["simulator"], bare["learner"], len(os.sched_getaffinity(0)))
    return Finding(updates * config.batch_size / config.samples_per_insert, updates, 0.0, None, 0, None)


if __name__ == "__main__":
    compete(measure)
