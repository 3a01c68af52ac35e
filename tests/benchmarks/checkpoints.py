"""How long training stands still for a checkpoint: the snapshot of a full shard, and the whole service over Ray."""

import tempfile
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
from rich.console import Console
from rich.table import Table

from actors.replay.node import ShardNode, ShardSettings
from actors.rollout.worker import join_stats
from actors.service.messages import SCHEMA_VERSION, BlockHeader, TransitionBlock, transition_dtype
from learner.config import RunConfig
from tests.benchmarks.timing import spread
from tests.benchmarks.whole_service import whole_service
from tests.checkpointing import Silent
from tests.packed import pack_as_collected

BLOCK = 2_048
ROUNDS = 5
CHECKPOINTS = 6
TARGET_MS = 100.0


def milliseconds(work) -> float:
    start_s = time.perf_counter()
    work()
    return 1000 * (time.perf_counter() - start_s)


class FilledShard:
    """A full shard of float32 observations, its inserts and its samples."""

    def __init__(self, size: int, capacity: int) -> None:
        self.dtype = transition_dtype(gym.spaces.Box(-1, 1, (size,), np.float32))
        self.node = ShardNode(ShardSettings(self.dtype, capacity, 0))
        rows = np.zeros(BLOCK, self.dtype)
        rows["observation"] = np.random.default_rng(0).normal(size=(BLOCK, size))
        self._packed = pack_as_collected(rows)
        self._sequence = 0
        while self.node.size() < capacity:
            self.add()

    def add(self) -> None:
        header = BlockHeader(SCHEMA_VERSION, 0, 0, self._sequence, 0, 0.0, 0.0, BLOCK)
        self._sequence += 1
        self.node.add(TransitionBlock(header, self._packed, join_stats([])))

    def step(self) -> None:
        """What a shard does between two checkpoints."""
        self.add()
        self.node.sample(4 * BLOCK)


def shard_row(size: int, capacity: int) -> list[str]:
    """One line of the first table: the snapshot, and the steps of the shard with and without a write under way."""
    shard = FilledShard(size, capacity)
    snapshots, quiet, writing, seconds = [], [], [], []
    with tempfile.TemporaryDirectory() as folder:
        for i in range(ROUNDS):
            quiet += [milliseconds(shard.step) for _ in range(50)]
            start_s = time.perf_counter()
            snapshots.append(milliseconds(lambda i=i: shard.node.save(Path(folder) / f"{i}.zarr")))
            while (written := shard.node.saved()) is None:
                writing.append(milliseconds(shard.step))
            seconds.append(time.perf_counter() - start_s)
            assert written.error is None, written.error
    rings = shard.node.shard.snapshot()
    megabytes = sum(len(ring) * ring.dtype.itemsize for ring in (rings.rows, rings.frames)) / 1e6
    return [
        f"{capacity:,} of {rings.rows.dtype.itemsize} B, frames: {megabytes:,.0f} MB",
        spread(snapshots).text(2),
        f"{np.median(quiet):.1f}, at most {max(quiet):.1f}",
        f"{np.median(writing):.1f}, at most {max(writing):.1f}",
        spread(seconds).text(2),
    ]


class Told(Silent):
    """Counts the checkpoints that were written."""

    def __init__(self) -> None:
        self.written = 0

    def checkpoint(self, folder, journal_offset) -> None:
        self.written += 1


def service_rows(config: RunConfig) -> list[tuple[str, list[float]]]:
    """Milliseconds that the loop stood still for each checkpoint, and gaps between updates with and without one."""
    told = Told()
    stalls, quiet, writing = [], [], []
    last = (0.0, 0)
    with whole_service(config) as make_loop:

        def stop() -> bool:
            nonlocal last
            now_s = time.perf_counter()
            if loop.updates > last[1]:
                if last[1]:
                    (writing if loop._checkpoints._writer.is_busy else quiet).append(1000 * (now_s - last[0]))
                last = (now_s, loop.updates)
            return told.written >= CHECKPOINTS

        loop = make_loop(told, stop)
        begin = loop.checkpoint
        loop.checkpoint = lambda: stalls.append(milliseconds(begin))
        loop.run()
    return [
        ("the loop settles and snapshots", stalls),
        ("between two calls of updates, no checkpoint", quiet),
        ("between two calls of updates, one being written", writing),
    ]


def main() -> None:
    table = Table(title=f"a shard's milliseconds, median (lowest … highest) of {ROUNDS}; target: < {TARGET_MS:.0f}")
    for column in ("full shard", "snapshot", "insert + sample", "the same, while it is written", "seconds to write"):
        table.add_column(column, justify="right")
    for size, capacity in ((16, 500_000), (72, 500_000), (72, 1_000_000)):
        table.add_row(*shard_row(size, capacity))
    console = Console(width=150)
    console.print(table)
    config = RunConfig(
        total_env_steps=10**9, eval_every_env_steps=10**9, checkpoint_every_env_steps=150_000, replay_capacity=400_000
    )
    table = Table(title=f"the service over Ray, {config.world.setup} M_sensor, {CHECKPOINTS} checkpoints; milliseconds")
    for column in ("what", "median", "highest"):
        table.add_column(column, justify="right")
    for what, values in service_rows(config):
        table.add_row(what, f"{np.median(values):.0f}", f"{max(values):.0f}")
    console.print(table)


if __name__ == "__main__":
    main()
