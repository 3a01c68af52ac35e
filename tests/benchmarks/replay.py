"""Million transitions per CPU second into and out of one replay shard, beside the buffers of other projects.

CPU time of the process counts, all threads together, so that other work on the machine does not. Observations are 72
float32. A block comes as each buffer likes it best: packed for ours, as rollout workers push it (64 environments,
3-step transitions), in columns for the others. A draw ends where an update begins: each column contiguous, in the
learner's dtypes, and for prioritised draws with importance weights. Peers come with the extra `peers`; one that is not
installed, or cannot do its part with the PyTorch that is, is named and left out.
"""

import importlib.util
import os
import time
import warnings
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from gymnasium.spaces import Box, Discrete
from rich.console import Console
from rich.table import Table

from actors.replay.node import ShardSettings, make_shard
from actors.replay.prioritised import PrioritySettings
from actors.rollout.worker import join_stats
from actors.service.messages import SCHEMA_VERSION, BlockHeader, TransitionBlock, transition_dtype
from learner.update.importance import importance_weights
from learner.update.learner import Columns
from tests.benchmarks.timing import ratio, spread, stopwatch, timed_rates
from tests.packed import pack_as_collected

SPACE = Box(-np.inf, np.inf, (72,), np.float32)
CAPACITY = 100_000
BLOCK, ENVS, BATCH, SUPER_BATCH = 2_048, 64, 256, 8_192
ALPHA, BETA = 0.6, 0.4
ROUNDS = 7
ADDED, DRAWN = 100 * BLOCK, 8 * SUPER_BATCH
Work = Callable[[], int]


class Rival(NamedTuple):
    """A buffer that is full.

    `add()` stores BLOCK transitions, `draw(count)` draws for an update and returns what `answer` needs, which gives
    the drawn transitions new priorities; it is None for a buffer that draws uniformly.
    """

    add: Callable[[], object]
    draw: Callable[[int], object]
    answer: Callable[[object], object] | None


def shoal_rival(prioritised: bool) -> Rival:
    priorities = PrioritySettings(ALPHA, BATCH) if prioritised else None
    shard = make_shard(ShardSettings(transition_dtype(SPACE), CAPACITY, 0, priorities))
    packed, episodes = pack_as_collected(np.zeros(BLOCK, transition_dtype(SPACE)), ENVS), join_stats([])
    sequence, columns_of = iter(range(10**9)), Columns()

    def add() -> None:
        header = BlockHeader(SCHEMA_VERSION, 0, 0, next(sequence), 0, 0.0, 0.0, BLOCK)
        shard.add(TransitionBlock(header, packed, episodes))

    def draw(count: int) -> object:
        reply = shard.sample(count)
        columns_of(reply.columns)
        if reply.draws is None:
            return None
        importance_weights(reply.draws.probability, BATCH, BETA)
        return reply.draws.insertion_index, errors_of(count)

    def answer(drawn) -> None:
        shard.set_priorities(*drawn)

    return Rival(add, draw, answer if prioritised else None)


def errors_of(count: int) -> np.ndarray:
    """TD errors for `count` drawn transitions, the same every time."""
    return ERRORS[:count]


ERRORS = np.abs(np.random.default_rng(0).normal(size=SUPER_BATCH)).astype(np.float32) + 1e-3


def sb3_rival(prioritised: bool) -> Rival | str:
    if prioritised:
        return "has none"
    from stable_baselines3.common.buffers import ReplayBuffer

    buffer = ReplayBuffer(CAPACITY, SPACE, Discrete(9), n_envs=ENVS, device="cpu")
    observation = np.zeros((ENVS, 72), np.float32)
    action, flags, infos = np.zeros((ENVS, 1), np.int64), np.zeros(ENVS), [{}] * ENVS

    def add() -> None:
        for _ in range(BLOCK // ENVS):
            buffer.add(observation, observation, action, flags, flags, infos)

    return Rival(add, buffer.sample, None)


def cpprb_rival(prioritised: bool) -> Rival | str:
    import cpprb

    single, row = {"dtype": np.float32}, {"dtype": np.float32, "shape": 72}
    columns = {"reward": single, "discount": single, "action": {"dtype": np.int64}, "observation": row}
    columns["next_observation"] = row
    kind = cpprb.PrioritizedReplayBuffer if prioritised else cpprb.ReplayBuffer
    buffer = kind(CAPACITY, columns, **({"alpha": ALPHA} if prioritised else {}))
    block = {name: np.zeros((BLOCK, column.get("shape", 1)), column["dtype"]) for name, column in columns.items()}

    def draw(count: int) -> object:
        drawn = buffer.sample(count, **({"beta": BETA} if prioritised else {}))
        return (drawn["indexes"], errors_of(count)) if prioritised else None

    def answer(drawn) -> None:
        buffer.update_priorities(*drawn)

    return Rival(lambda: buffer.add(**block), draw, answer if prioritised else None)


def torchrl_rival(prioritised: bool) -> Rival | str:
    import torch

    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of its compiled part, which is looked at below
        import torchrl.data
        from tensordict import TensorDict
    if prioritised and importlib.util.find_spec("torchrl._torchrl") is not None:
        try:
            import torchrl._torchrl  # noqa: F401
        except ImportError:
            return f"its compiled part does not load with PyTorch {torch.__version__}"
    sampler = torchrl.data.PrioritizedSampler(CAPACITY, ALPHA, BETA) if prioritised else None
    buffer = torchrl.data.ReplayBuffer(storage=torchrl.data.LazyTensorStorage(CAPACITY), sampler=sampler)
    columns = {name: torch.zeros(BLOCK) for name in ("reward", "discount")} | {"action": torch.zeros(BLOCK).long()}
    columns |= {name: torch.zeros(BLOCK, 72) for name in ("observation", "next_observation")}
    block = TensorDict(columns, batch_size=[BLOCK])

    def draw(count: int) -> object:
        _, info = buffer.sample(count, return_info=True)
        return info["index"], torch.from_numpy(errors_of(count))

    def answer(drawn) -> None:
        buffer.update_priority(*drawn)

    return Rival(lambda: buffer.extend(block), draw, answer if prioritised else None)


PEERS = {
    "Stable-Baselines3": ("stable_baselines3", sb3_rival),
    "cpprb": ("cpprb", cpprb_rival),
    "TorchRL": ("torchrl", torchrl_rival),
}


def peers(prioritised: bool, console: Console) -> Iterator[tuple[str, Rival]]:
    """The peers that can take part; the others are named."""
    for name, (module, make) in PEERS.items():
        if importlib.util.find_spec(module) is None:
            console.print(f"{name}: not installed (the extra `peers`), left out")
            continue
        rival = make(prioritised)
        if isinstance(rival, str):
            console.print(f"{name}, prioritised: {rival}, left out")
        else:
            yield name, rival


def adding(rival: Rival) -> Work:
    def work() -> int:
        for _ in range(ADDED // BLOCK):
            rival.add()
        return ADDED

    return work


def drawing(rival: Rival, count: int) -> Work:
    def work() -> int:
        for _ in range(DRAWN // count):
            rival.draw(count)
        return DRAWN

    return work


def learning(rival: Rival, count: int) -> Work:
    """Draws and answers in turn, as a learner does."""

    def work() -> int:
        for _ in range(DRAWN // count):
            rival.answer(rival.draw(count))
        return DRAWN

    return work


def operations(rivals: dict[str, Rival], prioritised: bool) -> Iterator[tuple[str, dict[str, Work]]]:
    for rival in rivals.values():
        for _ in range(CAPACITY // BLOCK + 1):
            rival.add()
    yield f"add, blocks of {BLOCK:,}", {name: adding(rival) for name, rival in rivals.items()}
    for count in (BATCH, SUPER_BATCH):
        yield f"draw {count:,}", {name: drawing(rival, count) for name, rival in rivals.items()}
        if prioritised:
            yield f"draw {count:,}, new priorities", {name: learning(rival, count) for name, rival in rivals.items()}


def main() -> None:
    console = Console(width=140)
    for prioritised in (False, True):
        rivals = {"shoal": shoal_rival(prioritised), **dict(peers(prioritised, console))}
        kind = "prioritised" if prioritised else "uniform"
        table = Table(title=f"{kind} replay, million transitions per CPU second (lowest … highest of {ROUNDS})")
        for column in ("operation", "buffer", "median (spread)", "shoal / it"):
            table.add_column(column, justify="left" if column == "buffer" else "right")
        for operation, works in operations(rivals, prioritised):
            timed = {name: stopwatch(work, time.process_time) for name, work in works.items()}
            found = {name: [rate / 1e6 for rate in values] for name, values in timed_rates(timed, ROUNDS).items()}
            for name, values in found.items():
                against = "" if name == "shoal" else ratio(found["shoal"], values).text(1)
                table.add_row(operation if name == "shoal" else "", name, spread(values).text(2), against)
            table.add_section()
        console.print(table)
