"""Ours, over Ray or in one process; the judge takes the place of the service's own evaluations, as with the peers."""

import dataclasses

from actors.policy.policy import WeightsSnapshot
from learner.presets import preset_config
from tests.benchmarks.contest import Finding, Heat, Lap, compete
from tests.benchmarks.entrants import ONE_PROCESS, SHORT_BLOCKS, TWO_WORKERS
from tests.benchmarks.whole_service import whole_service
from tests.checkpointing import Silent


def train(heat: Heat) -> Finding:
    workers = 2 if TWO_WORKERS in heat.variant else 1
    engine = "process" if ONE_PROCESS in heat.variant else "ray"
    ours = {"engine": engine, "workers": workers, "envs_per_worker": heat.envs, "eval_every_env_steps": 10**9}
    config = dataclasses.replace(heat.config, **ours)
    if SHORT_BLOCKS in heat.variant:
        preset = preset_config("best", config.world.method)
        blocks = {"steps_per_block": preset.steps_per_block, "updates_per_call": preset.updates_per_call}
        config = dataclasses.replace(config, **blocks)
    with whole_service(config) as make_loop:

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
