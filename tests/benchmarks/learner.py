"""Updates a CPU second of the learner on one thread, beside the same update in plain PyTorch."""

import copy
import time

import numpy as np
import torch
from gymnasium.spaces import Box
from rich.console import Console
from rich.table import Table

from actors.policy.network import QNetwork
from actors.service.messages import transition_dtype
from learner.update.double_dqn import as_batch, mean_loss, targets
from learner.update.learner import Columns, Learner
from learner.update.updates import LearnerSettings
from tests.benchmarks.timing import ratio, spread, stopwatch, timed_rates

SHAPES = (((16, 64, 64, 8), 64), ((16, 64, 64, 8), 256), ((16, 128, 128, 8), 256), ((72, 128, 128, 9), 256))
SHAPES += (((72, 256, 256, 9), 256), ((72, 256, 256, 9), 512))
UPDATES = 64
ROUNDS = 5
RATE = 1e-4


def random_rows(size: int, observation_size: int, num_actions: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    rows = np.zeros(size, transition_dtype(Box(-10, 10, (observation_size,), np.float32)))
    rows["observation"], rows["next_observation"] = rng.normal(size=(2, size, observation_size))
    rows["action"] = rng.integers(num_actions, size=size)
    rows["reward"], rows["discount"] = rng.normal(size=size), 0.99
    return rows


def our_work(rows: np.ndarray, sizes: tuple[int, ...], batch: int):
    settings = LearnerSettings(
        observation_size=sizes[0],
        num_actions=sizes[-1],
        hidden_sizes=sizes[1:-1],
        double=True,
        batch_size=batch,
        target_update_interval=500,
        max_gradient_norm=10.0,
        gradients="by_hand",
        seed=0,
        network="plain",
        loss="huber",
        soft_target_rate=None,
        device="cpu",
    )
    learner = Learner(settings)

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
            part = as_batch(columns, slice(start, start + batch))
            loss, _ = mean_loss(online(part.s_tm1), part.a_tm1, targets(part, online, target, True))
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
