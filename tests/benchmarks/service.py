"""Where the time goes: the bare simulator, the rollout worker, the learner, and the whole service over Ray."""

import dataclasses
import os
import time
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from actors.policy.network import snapshot
from actors.rollout.vector_env import env_shape, make_rollout_env
from actors.rollout.worker import RolloutWorker
from actors.service.messages import transition_dtype
from learner.config import RunConfig
from learner.training.cluster import rollout_settings
from learner.update.learner import Learner
from sim_core.config import WorldConfig
from tests.benchmarks.entrants import contests
from tests.benchmarks.timing import rates, ratio, spread, stopwatch, sustained, timed_rates
from tests.benchmarks.whole_service import ENDLESS, Point, measured_point

ROUNDS = 5
SERVICE_S = 20.0
BARE_S = 2.0


class Kind(NamedTuple):
    """A way to run the service over Ray; the shard of "actors" is a process of its own."""

    samples_per_insert: float
    replay_placement: str

    def text(self) -> str:
        where = "" if self.replay_placement == "learner" else ", shard of its own"
        return f"service over Ray, {self.samples_per_insert:g} samples per insert{where}"


SAMPLES_PER_INSERT = (2.0, 8.0)
"""With 2 the rollout worker and the learner fill a core each, with 8 the learner alone decides."""

KINDS = (*(Kind(samples, "learner") for samples in SAMPLES_PER_INSERT), Kind(8.0, "actors"))

SETUPS = (((10, 2), 1, 6), ((10, 2), 4, 2), ((10, 8), 1, 2), ((25, 8), 1, 1))
"""Setups whose rollout worker is set beside its bare simulator, simulator steps of a decision, blocks measured."""


def simulator_work(config: RunConfig, blocks: int):
    env = make_rollout_env(config.env, config.envs_per_worker)
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
    weights = snapshot(Learner(config, env_shape(config.env)).online, 0, 0.0)

    def work() -> int:
        env_steps = 0
        for _ in range(blocks):
            worker.set_weights(weights)  # as after every block of a training, which brings new ones
            env_steps += worker.collect(1.0).header.env_steps
        return env_steps

    return work


def learner_work(config: RunConfig):
    shape = env_shape(config.env)
    learner = Learner(config, shape)
    rows = np.zeros(config.batch_size * config.updates_per_call, transition_dtype(shape.observation_space))
    rows["observation"] = np.random.default_rng(0).integers(-5, 5, rows["observation"].shape)
    columns = {name: np.ascontiguousarray(rows[name]) for name in rows.dtype.names}  # as a shard draws them

    def work() -> int:
        for _ in range(4):
            learner.update(columns, config.learning_rate)
        return 4 * config.updates_per_call

    return work


def rollout_table() -> Table:
    """The rollout worker of small and large worlds, of the bare simulator of each; in CPU time of the process."""
    table = Table(title="rollout worker, M_sensor, one core; rates, median (lowest … highest)")
    columns = ("setup", "steps a decision", "bare simulator, env steps/s", "rollout worker, env steps/s")
    for column in (*columns, "of the bare simulator"):
        table.add_column(column, justify="right")
    for (robots, groups), interval, blocks in SETUPS:
        config = RunConfig(**ENDLESS, world=WorldConfig(robots=robots, groups=groups, decision_interval_steps=interval))
        works = {"simulator": simulator_work(config, blocks), "worker": worker_work(config, blocks)}
        found = timed_rates({name: stopwatch(work, time.process_time) for name, work in works.items()}, ROUNDS)
        share = ratio(found["worker"], found["simulator"])
        rates_of = (spread(found[name]).text() for name in works)
        table.add_row(config.world.setup, str(interval), *rates_of, share.text(2))
    return table


def service_table(config: RunConfig, rounds: int) -> Table:
    """The service over Ray, of its bare parts, which are measured anew in every round."""
    works = {"simulator": simulator_work(config, 6), "learner": learner_work(config)}
    bare = {name: sustained(work, BARE_S) for name, work in works.items()}
    alone: dict[str, list[float]] = {name: [] for name in bare}
    points: dict[Kind, list[Point]] = {kind: [] for kind in KINDS}
    for _ in range(rounds):
        for kind in KINDS:
            for name, work in bare.items():
                alone[name] += rates({name: work}, 1)[name]
            points[kind].append(measured_point(dataclasses.replace(config, **kind._asdict()), SERVICE_S))
    table = Table(title=f"{config.world.setup} M_sensor, median (lowest … highest)")
    for column in ("part", "env steps/s", "updates/s", "of the bare simulator", "of the bare learner"):
        table.add_column(column, justify="right")
    table.add_row("bare simulator, one core", spread(alone["simulator"]).text(), "", "", "")
    table.add_row(f"bare learner, batch {config.batch_size}, one core", "", spread(alone["learner"]).text(), "", "")
    for i, kind in enumerate(KINDS):
        env_steps = [point.env_steps_per_s for point in points[kind]]
        updates = [point.updates_per_s for point in points[kind]]
        mine = {name: found[i :: len(KINDS)] for name, found in alone.items()}
        shares = (ratio(env_steps, mine["simulator"]).text(2), ratio(updates, mine["learner"]).text(2))
        table.add_row(kind.text(), spread(env_steps).text(), spread(updates).text(), *shares)
    return table


def most_updates(config: RunConfig, env_steps_per_s: float, updates_per_s: float, cores: int) -> float:
    """Updates a second of `cores` cores of which each makes so many env steps or so many updates a second."""
    env_steps = config.batch_size / config.samples_per_insert  # for each update
    seconds = env_steps / env_steps_per_s + 1 / updates_per_s
    return min(updates_per_s, cores / seconds)


def limited_configs() -> dict[str, RunConfig]:
    """Trainings that are set beside their limit, by what they are; CartPole's are those of the peers."""
    cartpole, cartpole475 = (contests()[name].config for name in ("cartpole", "cartpole475"))
    found = {f"CartPole, batch {config.batch_size}": config for config in (cartpole475, cartpole)}
    swarm = RunConfig()
    slow = dataclasses.replace(swarm, workers=2, world=dataclasses.replace(swarm.world, decision_interval_steps=4))
    found |= {"10r×2g": swarm, "10r×2g, a decision every 4 steps, 2 workers": slow}
    return {name: dataclasses.replace(config, envs_per_worker=128, **ENDLESS) for name, config in found.items()}


def limit_table(rounds: int) -> Table:
    """The service over Ray beside what bare simulation and bare updates, measured in every round, leave time for."""
    cores = len(os.sched_getaffinity(0))
    table = Table(title=f"the service over Ray on {cores} cores, and its limit; median (lowest … highest)")
    columns = ("training", "bare: env steps/s", "updates/s", "limit: updates/s", "service: updates/s", "of the limit")
    for column in (*columns, "CPU, µs an update: learner", "workers", "driver", "Ray"):
        table.add_column(column, justify="right")
    for name, config in limited_configs().items():
        bare: dict[str, list[float]] = {"simulator": [], "learner": []}
        limits, points = [], []
        for _ in range(rounds):
            works = {"simulator": simulator_work(config, 2), "learner": learner_work(config)}
            for part, work in works.items():
                bare[part] += rates({part: sustained(work, BARE_S)}, 1)[part]
            limits.append(most_updates(config, bare["simulator"][-1], bare["learner"][-1], cores))
            points.append(measured_point(config, SERVICE_S))
        updates = [point.updates_per_s for point in points]
        share = ratio(updates, limits).text(2)
        numbers = [spread(values).text() for values in (*bare.values(), limits, updates)]
        table.add_row(name, *numbers, share, *cpu_of_an_update(points))
    return table


def cpu_of_an_update(points: list[Point]) -> list[str]:
    """CPU time in microseconds of learner, rollout workers, driver and Ray's own processes; medians."""
    each: list[list[float]] = [[], [], [], []]
    for point in points:
        known = [point.cpu_s.get(kind, 0.0) for kind in ("learner", "rollout worker", "driver")]
        steps = point.env_steps_per_s / point.updates_per_s
        for seconds, column in zip((*known, sum(point.cpu_s.values()) - sum(known)), each, strict=True):
            column.append(1e6 * seconds * steps)
    return [f"{spread(column).median:.1f}" for column in each]


def main(rounds: int) -> None:
    console = Console(width=200)
    console.print(rollout_table())
    for table in (service_table(RunConfig(**ENDLESS), rounds), limit_table(rounds)):
        console.print(table)
