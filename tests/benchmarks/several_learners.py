"""The plan for when one learner is full: several that share a batch, and sum their gradients before every step.

What is measured is the update of a part of the batch, and an all-reduce of the flat gradient between two processes of
this machine (gloo over loopback); a ring of n makes n - 1 times the steps of a ring of two, each with fewer bytes.
"""

import dataclasses
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from rich.table import Table

from learner.config import RunConfig
from tests.benchmarks.service import learner_work
from tests.benchmarks.service_model import Costs, Work, of_several_learners
from tests.benchmarks.timing import spread, stopwatch, timed_rates

LEARNERS = (1, 2, 4, 8)
ROUNDS = 5
SUMS = 500
"""All-reduces that are timed together."""


def update_seconds(config: RunConfig) -> dict[int, float]:
    """CPU seconds of an update by each of so many learners, of its part of the batch."""
    works = {
        str(count): stopwatch(
            learner_work(dataclasses.replace(config, batch_size=config.batch_size // count)), time.process_time
        )
        for count in LEARNERS
    }
    return {int(count): 1 / spread(found).median for count, found in timed_rates(works, ROUNDS).items()}


def sum_seconds(floats: int) -> float:
    """Seconds of an all-reduce of so many float32 between two processes."""
    with tempfile.TemporaryDirectory() as folder:
        mp.spawn(_sum_often, (floats, folder), nprocs=2)
        return float((Path(folder) / "seconds").read_text("utf-8"))


def _sum_often(rank: int, floats: int, folder: str) -> None:
    os.environ["GLOO_SOCKET_IFNAME"] = "lo"
    dist.init_process_group("gloo", init_method=f"file://{folder}/meeting", rank=rank, world_size=2)
    try:
        gradient = torch.zeros(floats)
        found = timed_rates({"sum": stopwatch(_sums_of(gradient))}, ROUNDS)["sum"]
    finally:
        dist.destroy_process_group()
    if rank == 0:
        (Path(folder) / "seconds").write_text(str(1 / spread(found).median), "utf-8")


def _sums_of(gradient: torch.Tensor) -> Callable[[], int]:
    def work() -> int:
        for _ in range(SUMS):
            dist.all_reduce(gradient)
        return SUMS

    return work


def learners_table(costs: Costs, work: Work, updates_s: dict[int, float], sum_s: float) -> Table:
    """What so many learners could do, each with a core of its own and its share of the replay in its process."""
    table = Table(title=f"several learners, by the model; a sum of the gradients of two takes {1e6 * sum_s:,.0f} µs")
    columns = ("learners", "batch of each", "its update, µs", "env steps/s", "of one learner")
    for column in columns:
        table.add_column(column, justify="right")
    alone = of_several_learners(costs, work, 1, updates_s[1], sum_s)
    for count, update_s in updates_s.items():
        rate = of_several_learners(costs, work, count, update_s, sum_s)
        table.add_row(
            f"{count}",
            f"{work.batch_size // count}",
            f"{1e6 * update_s:,.0f}",
            f"{rate:,.0f}",
            f"{rate / alone:.2f}",
        )
    return table
