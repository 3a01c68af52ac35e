"""What each hop of the service costs by itself, in CPU seconds: the bare parts, and calls of a Ray actor."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import ray

from actors.policy.policy import WeightsSnapshot
from actors.replay.node import make_shard
from actors.rollout.vector_env import env_shape
from actors.rollout.worker import RolloutWorker
from actors.service.messages import TransitionBlock
from learner.config import RunConfig
from learner.ray_backend.cluster import connect, leave
from learner.training.cluster import rollout_settings, shard_settings
from learner.update.learner import Learner
from tests.benchmarks.service import learner_work, worker_work
from tests.benchmarks.service_model import Costs
from tests.benchmarks.timing import spread, stopwatch, timed_rates

ROUNDS = 5
CALLS = 200


class Hop:
    """The far side of every kind of call, as a Ray actor."""

    def __init__(self, config: RunConfig, block: TransitionBlock, weights: WeightsSnapshot) -> None:
        self._weights = weights
        self._shard = make_shard(shard_settings(config, env_shape(config.env))[0])
        self._sequence = 0
        while self._shard.size < config.replay_capacity:
            self.store(block)

    def cpu_s(self) -> float:
        """CPU time of this process so far, Ray's threads included."""
        return time.process_time()

    def nothing(self) -> None:
        """An order that is done at once."""

    def store(self, block: TransitionBlock) -> WeightsSnapshot:
        """Stores a block as if it were new; the reply carries weights."""
        self._sequence += 1
        header = block.header._replace(sequence=self._sequence)
        self._shard.add(block._replace(header=header))
        return self._weights

    def receive(self, weights: WeightsSnapshot) -> None:
        """Takes weights."""
        self._weights = weights

    def give(self, count: int) -> dict[str, np.ndarray]:
        """Columns of transitions that are drawn here."""
        return self._shard.sample(count).columns


def cpu_of_calls(hop: Any, call: Callable[[], Any], count: int = CALLS) -> tuple[float, float]:
    """CPU seconds that one of `count` calls costs (here, there)."""
    call()
    there, here = ray.get(hop.cpu_s.remote()), time.process_time()
    for _ in range(count):
        call()
    here = time.process_time() - here
    return here / count, (ray.get(hop.cpu_s.remote()) - there) / count


def measured_costs(config: RunConfig) -> Costs:
    """Costs of all hops, each by itself."""
    bare = {"worker": worker_work(config, 6), "learner": learner_work(config)}
    found = timed_rates({name: stopwatch(one, time.process_time) for name, one in bare.items()}, ROUNDS)
    shape, rows = env_shape(config.env), config.batch_size * config.updates_per_call
    learner, worker = Learner(config, shape), RolloutWorker(rollout_settings(config), 0, 0)
    worker.set_weights(learner.weights(0.0))
    block = worker.collect(0.1)
    connect(2, None)
    try:
        hop = ray.remote(num_cpus=1)(Hop).remote(config, block, learner.weights(0.0))
        ask, do = cpu_of_calls(hop, lambda: ray.get(hop.nothing.remote()))
        push, store = cpu_of_calls(hop, lambda: ray.get(hop.store.remote(block)))
        take, give = cpu_of_calls(hop, lambda: ray.get(hop.give.remote(rows)))
        weights = learner.weights(0.0)
        send, receive = cpu_of_calls(hop, lambda: ray.get(hop.receive.remote(weights)))
        publish, _ = cpu_of_calls(hop, lambda: learner.weights(0.0))
    finally:
        leave()
    return Costs(
        env_step=1 / spread(found["worker"]).median,
        update=1 / spread(found["learner"]).median,
        draw=cpu_of_a_draw(config, block, rows),
        ask=ask,
        do=do,
        push=push,
        store=store,
        give=max(0.0, give - do) / rows,
        take=max(0.0, take - ask) / rows,
        publish=publish,
        send=send,
        receive=receive,
    )


def cpu_of_a_draw(config: RunConfig, block: TransitionBlock, count: int) -> float:
    """CPU seconds of a row that is drawn in its own process."""
    hop = Hop(config, block, WeightsSnapshot(0, 0.0, ()))

    def draw() -> int:
        hop.give(count)
        return count

    return 1 / spread(timed_rates({"draw": stopwatch(draw, time.process_time)}, 20)["draw"]).median
