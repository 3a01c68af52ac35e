"""Where the time goes: the bare simulator, the rollout worker, the learner, and the whole service over Ray."""

import dataclasses

import numpy as np
from rich.console import Console
from rich.table import Table

from actors.network import snapshot
from actors.rollout import RolloutWorker
from actors.transitions import transition_dtype
from actors.vector_env import env_shape, make_vector_env
from learner.cluster import learner_settings, rollout_settings
from learner.config import RunConfig
from learner.learner import Learner
from sim_core.config import WorldConfig
from tests.benchmarks.ray_service import ENDLESS, measured_point
from tests.benchmarks.timing import rates, ratio, spread

ROUNDS = 5
SERVICE_S = 30.0
SAMPLES_PER_INSERT = (2.0, 8.0)
"""With 2 the rollout worker and the learner fill a core each, with 8 the learner alone decides."""

SETUPS = (((10, 2), 6), ((10, 8), 2), ((25, 8), 1))
"""Setups whose rollout worker is set beside its bare simulator, and blocks of one measurement."""


def simulator_work(config: RunConfig, blocks: int):
    env = make_vector_env(config.env, config.envs_per_worker)
    env.reset(seed=0)
    actions = np.random.default_rng(0).integers(
        env.single_action_space.n, size=(blocks * config.steps_per_block, config.envs_per_worker)
    )

    def work() -> int:
        for action in actions:
            env.step(action)
        return actions.size

    return work


def worker_work(config: RunConfig, blocks: int):
    worker = RolloutWorker(rollout_settings(config), 0, 0)
    learner = Learner(learner_settings(config, env_shape(config.env)))
    worker.set_weights(snapshot(learner.online, 0, 0.0))

    def work() -> int:
        return sum(worker.collect(1.0).header.env_steps for _ in range(blocks))

    return work


def learner_work(config: RunConfig):
    shape = env_shape(config.env)
    learner = Learner(learner_settings(config, shape))
    rows = np.zeros(config.batch_size * config.updates_per_call, transition_dtype(shape.observation_space))
    rows["observation"] = np.random.default_rng(0).integers(-5, 5, rows["observation"].shape)
    columns = {name: np.ascontiguousarray(rows[name]) for name in rows.dtype.names}  # as a shard draws them

    def work() -> int:
        for _ in range(4):
            learner.update(columns, config.learning_rate)
        return 4 * config.updates_per_call

    return work


def rollout_table() -> Table:
    """The rollout worker of small and large worlds, of the bare simulator of each."""
    table = Table(title="rollout worker, M_sensor, one core; rates, median (lowest … highest)")
    for column in ("setup", "bare simulator, env steps/s", "rollout worker, env steps/s", "of the bare simulator"):
        table.add_column(column, justify="right")
    for (robots, groups), blocks in SETUPS:
        config = RunConfig(**ENDLESS, world=WorldConfig(robots=robots, groups=groups))
        works = {"simulator": simulator_work(config, blocks), "worker": worker_work(config, blocks)}
        found = rates(works, ROUNDS)
        share = ratio(found["worker"], found["simulator"])
        table.add_row(config.world.setup, *(spread(found[name]).text() for name in works), share.text(2))
    return table


def service_table(config: RunConfig) -> Table:
    """The service over Ray, of its bare parts."""
    bare = {"simulator": simulator_work(config, 6), "learner": learner_work(config)}
    found = {name: rates({name: work}, ROUNDS)[name] for name, work in bare.items()}
    table = Table(title=f"{config.world.setup} M_sensor")
    for column in ("part", "env steps/s", "updates/s", "of the bare part"):
        table.add_column(column, justify="right")
    simulator, learner = spread(found["simulator"]), spread(found["learner"])
    table.add_row("bare simulator, one core", simulator.text(), "", "")
    table.add_row(f"bare learner, batch {config.batch_size}, one core", "", learner.text(), "")
    for samples in SAMPLES_PER_INSERT:
        service = measured_point(dataclasses.replace(config, samples_per_insert=samples), SERVICE_S)
        shares = service.env_steps_per_s / simulator.median, service.updates_per_s / learner.median
        table.add_row(
            f"service over Ray, 1 worker + learner, {samples:g} samples per insert",
            f"{service.env_steps_per_s:,.0f}",
            f"{service.updates_per_s:,.0f}",
            " · ".join(f"{share:.2f}" for share in shares),
        )
    return table


def main() -> None:
    console = Console(width=140)
    for table in (rollout_table(), service_table(RunConfig(**ENDLESS))):
        console.print(table)
