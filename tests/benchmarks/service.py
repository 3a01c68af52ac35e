"""Where the time goes: the bare simulator, the rollout worker, the learner, and the whole service over Ray."""

import time

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
from tests.benchmarks.ray_service import ray_service
from tests.benchmarks.timing import rates, ratio, spread
from tests.checkpointing import Silent

ROUNDS = 5
SERVICE_S = 30.0


def simulator_work(config: RunConfig):
    env = make_vector_env(config.env, config.envs_per_worker)
    env.reset(seed=0)
    actions = np.random.default_rng(0).integers(env.single_action_space.n, size=(400, config.envs_per_worker))

    def work() -> int:
        for action in actions:
            env.step(action)
        return actions.size

    return work


def worker_work(config: RunConfig):
    worker = RolloutWorker(rollout_settings(config), 0, 0)
    learner = Learner(learner_settings(config, env_shape(config.env)))
    worker.set_weights(snapshot(learner.online, 0, 0.0))

    def work() -> int:
        return sum(worker.collect(1.0).header.env_steps for _ in range(12))

    return work


def learner_work(config: RunConfig):
    shape = env_shape(config.env)
    learner = Learner(learner_settings(config, shape))
    rows = np.zeros(config.batch_size * config.updates_per_call, transition_dtype(shape.observation_space))
    rows["observation"] = np.random.default_rng(0).integers(-5, 5, rows["observation"].shape)

    def work() -> int:
        for _ in range(4):
            learner.update(rows, config.learning_rate)
        return 4 * config.updates_per_call

    return work


def service_rates(config: RunConfig) -> tuple[float, float]:
    """(env steps/s, updates/s) of the whole service in its steady state."""
    marks: list[tuple[float, int, int]] = []
    with ray_service(config) as make_loop:

        def stop() -> bool:
            if loop.updates and (not marks or time.perf_counter() - marks[0][0] < SERVICE_S):
                marks.append((time.perf_counter(), loop.env_steps, loop.updates))
            return bool(marks) and time.perf_counter() - marks[0][0] >= SERVICE_S

        loop = make_loop(Silent(), stop)
        loop.run()
    (start_s, start_steps, start_updates), (end_s, end_steps, end_updates) = marks[0], marks[-1]
    elapsed_s = end_s - start_s
    return (end_steps - start_steps) / elapsed_s, (end_updates - start_updates) / elapsed_s


def main() -> None:
    config = RunConfig(total_env_steps=10**9, eval_every_env_steps=10**9, checkpoint_every_env_steps=10**9)
    bare = {"simulator": simulator_work(config), "worker": worker_work(config)}
    found = rates(bare, ROUNDS)
    learner = rates({"learner": learner_work(config)}, ROUNDS)["learner"]
    env_steps, updates = service_rates(config)
    table = Table(title=f"{config.world.setup} M_sensor, {config.samples_per_insert:g} samples per insert")
    for column in ("part", "env steps/s", "updates/s", "of the bare part"):
        table.add_column(column, justify="right")
    table.add_row("bare simulator, one core", spread(found["simulator"]).text(), "", "")
    share = ratio(found["worker"], found["simulator"])
    table.add_row("rollout worker, one core", spread(found["worker"]).text(), "", share.text(2))
    table.add_row(f"bare learner, batch {config.batch_size}, one core", "", spread(learner).text(), "")
    table.add_row(
        "service over Ray, 1 worker + learner",
        f"{env_steps:,.0f}",
        f"{updates:,.0f}",
        f"{env_steps / spread(found['simulator']).median:.2f} · {updates / spread(learner).median:.2f}",
    )
    Console(width=140).print(table)
