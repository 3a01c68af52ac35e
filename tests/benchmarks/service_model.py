"""What the parts of the service cost predicts how fast it runs: a model of its hops, in CPU seconds.

Every hop has one process that serves it (or several: the rollout workers, the shards), so that it can do no more
env steps a second than 1 / (its CPU seconds per env step) times the number of its processes; and all processes together
can spend no more than the machine's cores. The smallest of these bounds is the prediction.
"""

import math
from typing import NamedTuple


class Costs(NamedTuple):
    """CPU seconds, each measured by itself.

    `env_step` of a rollout worker and `update` of the learner are those of the bare parts; the learner's `draw` is
    of one row from a shard in its own process. A call costs who asks `ask` and who does it `do`. A block, with weights
    in the reply, costs who pushes it `push` and who stores it `store`; a row that another process drew costs `give`
    there and `take` here. New weights cost the learner `publish`, and for each shard in a process of its own a call
    that costs `send` there and `receive` here.
    """

    env_step: float
    update: float
    draw: float
    ask: float
    do: float
    push: float
    store: float
    give: float
    take: float
    publish: float
    send: float
    receive: float


class Work(NamedTuple):
    """Sizes that a run's config sets, and the bytes of one transition, packed and whole, and of the weights."""

    block_env_steps: int
    samples_per_insert: float
    batch_size: int
    updates_per_call: int
    packed_bytes: float
    row_bytes: int
    weights_bytes: int

    @property
    def calls_per_env_step(self) -> float:
        """Calls of updates per env step."""
        return self.samples_per_insert / (self.batch_size * self.updates_per_call)


class Bound(NamedTuple):
    """Env steps a second that a hop allows."""

    hop: str
    env_steps_per_s: float


WORKERS, LEARNER, SHARDS, DRIVER, CORES = "rollout workers", "learner", "replay shards", "driver", "cores"
MANY = 10**9
"""Rollout workers that are never what limits."""


def seconds_per_env_step(costs: Costs, work: Work, shards: int) -> dict[str, float]:
    """CPU seconds per env step of each hop, all its processes together.

    `shards` is the number of those with processes of their own, 0 where they live in the learner's. Every reply to a
    block counts as one with weights, also where there are more blocks than versions of the policy.
    """
    rows, blocks, calls = work.samples_per_insert, 1 / work.block_env_steps, work.calls_per_env_step
    worker = costs.env_step + blocks * (costs.do + costs.push)
    learner = rows / work.batch_size * costs.update + calls * (costs.do + costs.publish)
    driver = (blocks + calls) * costs.ask
    if shards:
        learner += calls * shards * (costs.ask + costs.send) + rows * costs.take
        given = blocks * costs.store + rows * costs.give + calls * shards * (costs.do + costs.receive)
        return {WORKERS: worker, LEARNER: learner, SHARDS: given, DRIVER: driver}
    return {WORKERS: worker, LEARNER: learner + blocks * costs.store + rows * costs.draw, DRIVER: driver}


def bounds(costs: Costs, work: Work, workers: int, shards: int = 0, cores: float = math.inf) -> list[Bound]:
    """What each hop allows, the tightest first."""
    seconds = seconds_per_env_step(costs, work, shards)
    processes = {WORKERS: workers, SHARDS: shards}
    found = [Bound(hop, processes.get(hop, 1) / spent) for hop, spent in seconds.items()]
    found.append(Bound(CORES, cores / sum(seconds.values())))
    return sorted(found, key=lambda bound: bound.env_steps_per_s)


def saturation(costs: Costs, work: Work, shards: int) -> dict[str, float]:
    """How many rollout workers each other hop takes up: a shard one's share, whose number is as free as theirs."""
    seconds = seconds_per_env_step(costs, work, shards)
    return {hop: seconds[WORKERS] / spent for hop, spent in seconds.items() if hop != WORKERS}


def of_several_learners(costs: Costs, work: Work, learners: int, update_s: float, sum_s: float) -> float:
    """Env steps a second that learners allow who share every batch.

    Each draws its part from shards in its own process and updates in `update_s`; then all sum their gradients around a
    ring, which takes two of them `sum_s`.
    """
    rows, blocks, calls = work.samples_per_insert, 1 / work.block_env_steps, work.calls_per_env_step
    together = rows / work.batch_size * (update_s + (learners - 1) * sum_s) + calls * (costs.do + costs.publish)
    return 1 / (together + (blocks * costs.store + rows * costs.draw) / learners)


def shards_needed(costs: Costs, work: Work) -> int:
    """Shards in processes of their own with which something else is full before them."""
    shards = 1
    while bounds(costs, work, MANY, shards)[0].hop == SHARDS:
        shards += 1
    return shards


def network_bytes(work: Work, workers: float, shards: int) -> float:
    """Bytes between processes per env step: blocks, samples of shards in other processes, and weights.

    Shards in other processes get each version; a worker gets one with the reply to its next block.
    """
    samples = work.samples_per_insert if shards else 0.0
    versions = min(workers * work.calls_per_env_step, 1 / work.block_env_steps) + shards * work.calls_per_env_step
    return work.packed_bytes + samples * work.row_bytes + versions * work.weights_bytes


def messages(work: Work, shards: int) -> float:
    """Calls between processes per env step, replies not counted: orders, pushes, samples, publications."""
    per_call = 1 + 2 * shards  # the order to update; a sample from, and the news of weights to, every shard
    return 2 / work.block_env_steps + work.calls_per_env_step * per_call
