"""Million transitions a second into and out of one replay shard, beside Stable-Baselines3's buffer."""

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.buffers import ReplayBuffer

from actors.replay import ReplayShard
from actors.rollout import join_stats
from actors.transitions import SCHEMA_VERSION, BlockHeader, TransitionBlock, transition_dtype
from tests.benchmarks.timing import rates, ratio, spread

SPACE = Box(-np.inf, np.inf, (72,), np.float32)
CAPACITY = 100_000
BLOCK, BATCH = 2_048, 256
ROUNDS = 5
REPEATS = 200


def shard_work() -> dict:
    shard = ReplayShard(transition_dtype(SPACE), CAPACITY, 0)
    rows = np.zeros(BLOCK, transition_dtype(SPACE))
    sequence = iter(range(10**9))

    def add() -> int:
        for _ in range(REPEATS):
            header = BlockHeader(SCHEMA_VERSION, 0, 0, next(sequence), 0, 0.0, 0.0, BLOCK)
            shard.add(TransitionBlock(header, rows, join_stats([])))
        return REPEATS * BLOCK

    def sample() -> int:
        for _ in range(REPEATS):
            shard.sample(BATCH)
        return REPEATS * BATCH

    return {"add": add, "sample": sample}


def peer_work() -> dict:
    envs = 64
    buffer = ReplayBuffer(CAPACITY, SPACE, Discrete(9), n_envs=envs, device=torch.device("cpu"))
    observation = np.zeros((envs, 72), np.float32)
    action, flags, infos = np.zeros((envs, 1), np.int64), np.zeros(envs), [{}] * envs

    def add() -> int:
        for _ in range(REPEATS * BLOCK // envs):
            buffer.add(observation, observation, action, flags, flags, infos)
        return REPEATS * BLOCK

    def sample() -> int:
        for _ in range(REPEATS):
            buffer.sample(BATCH)
        return REPEATS * BATCH

    return {"add": add, "sample": sample}


def main() -> None:
    own, peer = shard_work(), peer_work()
    table = Table(title=f"million transitions/s, 72 float32 observations, median (lowest … highest) of {ROUNDS}")
    for column in ("operation", "shoal shard", "Stable-Baselines3 (64 envs)", "ratio"):
        table.add_column(column, justify="right")
    for name, title in (("add", f"add, blocks of {BLOCK}"), ("sample", f"sample {BATCH}")):
        found = rates({"own": own[name], "peer": peer[name]}, ROUNDS)
        ours, theirs = ([value / 1e6 for value in found[key]] for key in ("own", "peer"))
        table.add_row(title, spread(ours).text(2), spread(theirs).text(2), ratio(ours, theirs).text(1))
    Console(width=140).print(table)
