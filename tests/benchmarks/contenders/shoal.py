"""Ours, over Ray; the judge takes the place of the service's own evaluations, as with the peers."""

import dataclasses

from actors.policy.policy import WeightsSnapshot
from tests.benchmarks.contest import Finding, Heat, Lap, compete
from tests.benchmarks.entrants import TWO_WORKERS
from tests.benchmarks.ray_service import ray_service
from tests.checkpointing import Silent


def train(heat: Heat) -> Finding:
    workers = 2 if heat.variant == TWO_WORKERS else 1
    config = dataclasses.replace(heat.config, workers=workers, envs_per_worker=heat.envs, eval_every_env_steps=10**9)
    with ray_service(config) as make_loop:

        def weights() -> WeightsSnapshot:
            loop.settle()  # or workers and learner would go on while the watch stands still
            return loop.newest_weights()

        loop = make_loop(Silent(), lambda: lap.over(loop.env_steps, loop.updates, weights))
        weights()  # all processes answer: environments and Ray are up, as the peers' are when their watch starts
        lap = Lap(heat)
        loop.run()
        return lap.finding()


if __name__ == "__main__":
    compete(train)
