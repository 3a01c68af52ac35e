"""Updates a CPU second of the learner on one thread, beside the same update in plain PyTorch."""

import copy
import time

import numpy as np
import torch
from gymnasium.spaces import Box
from rich.console import Console
from rich.table import Table

from actors.policy.network import QNetwork
from actors.rollout.vector_env import EnvShape
from actors.service.messages import transition_dtype
from learner.config import RunConfig
from learner.update.double_dqn import mean_loss, minibatch, td_targets
from learner.update.learner import Columns, Learner
from tests.benchmarks.timing import ratio, spread, stopwatch, timed_rates

SHAPES = (((16, 64, 64, 8), 64), ((16, 64, 64, 8), 256), ((16, 128, 128, 8), 256), ((72, 128, 128, 9), 256))
SHAPES += (((72, 256, 256, 9), 256), ((72, 256, 256, 9), 512))
UPDATES = 64
ROUNDS = 5
RATE = 1e-4


def space_of(observation_size: int) -> Box:
    return Box(-10, 10, (observation_size,), np.float32)


def random_rows(size: int, observation_size: int, num_actions: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    rows = np.zeros(size, transition_dtype(space_of(observation_size)))
    rows["observation"], rows["next_observation"] = rng.normal(size=(2, size, observation_size))
    rows["action"] = rng.integers(num_actions, size=size)
    rows["reward"], rows["discount"] = rng.normal(size=size), 0.99
    return rows


def our_work(rows: np.ndarray, sizes: tuple[int, ...], batch: int):
    config = RunConfig(hidden_sizes=sizes[1:-1], batch_size=batch, device="cpu")
    learner = Learner(config, EnvShape(space_of(sizes[0]), sizes[-1]))

    def work() -> int:
        learner.update(rows, RATE)
        return UPDATES

    return work


def plain_work(rows: np.ndarray, sizes: tuple[int, ...], batch: int):
    """What a reader of a textbook would write: autograd, fused Adam, gradients clipped."""
    online = QNetwork(sizes[0], sizes[1:-1], sizes[-1])
    target = copy.deepcopy(online)
    columns_of = Columns()
    optimiser = torch.optim.Adam(online.parameters(), lr=RATE, fused=True)

    def work() -> int:
        columns = columns_of(rows)
        for start in range(0, len(rows), batch):
            part = minibatch(columns, slice(start, start + batch))
            with torch.no_grad():
                goal = td_targets(target(part.s_t), online(part.s_t), part.r_t, part.discount_t)
            loss, _ = mean_loss(online(part.s_tm1), part.a_tm1, goal)
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(online.parameters(), 10.0)
            optimiser.step()
        return UPDATES

    return work


def main() -> None:
    torch.set_num_threads(1)
    table = Table(title=f"updates per CPU second of Double DQN, one thread, median (lowest … highest) of {ROUNDS}")
    for column in ("network", "batch", "shoal", "eager PyTorch, fused Adam", "ratio"):
        table.add_column(column, justify="right")
    for sizes, batch in SHAPES:
        rows = random_rows(UPDATES * batch, sizes[0], sizes[-1])
        works = {"own": our_work(rows, sizes, batch), "plain": plain_work(rows, sizes, batch)}
        found = timed_rates({name: stopwatch(work, time.process_time) for name, work in works.items()}, ROUNDS)
        ours, theirs = found["own"], found["plain"]
        numbers = (spread(ours).text(), spread(theirs).text(), ratio(ours, theirs).text(2))
        table.add_row("-".join(map(str, sizes)), str(batch), *numbers)
    Console(width=140).print(table)
