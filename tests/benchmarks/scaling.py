"""How the service scales: what each hop costs, what a model makes of that, and what the service really does."""

import dataclasses
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import psutil
from rich.console import Console
from rich.table import Table

from actors.rollout.vector_env import env_shape
from actors.service.messages import transition_dtype
from actors.service.packing import estimate_frames, packed_dtype
from learner.config import RunConfig
from learner.update.learner import Learner
from tests.benchmarks.hop_costs import measured_costs
from tests.benchmarks.service_model import (
    LEARNER,
    MANY,
    Costs,
    Work,
    bounds,
    messages,
    network_bytes,
    saturation,
    seconds_per_env_step,
    shards_needed,
)
from tests.benchmarks.several_learners import learners_table, sum_seconds, update_seconds
from tests.benchmarks.whole_service import ENDLESS, Point, measured_point

POINTS = ((1, 2.0), (2, 2.0), (4, 2.0), (8, 2.0), (16, 2.0), (32, 2.0), (1, 0.25), (2, 0.25), (1, 8.0), (2, 8.0))
"""Rollout workers and samples per insert that are measured."""
COUNTED_S = 10.0
PICTURE = Path(__file__).parents[2] / "dashboards" / "images" / "service-model.png"


def microseconds(value: float) -> str:
    return f"{1e6 * value:,.2f}"


def cost_table(costs: Costs, work: Work) -> Table:
    table = Table(title="what each hop costs, CPU microseconds")
    table.add_column("cost")
    table.add_column("each", justify="right")
    table.add_column("of")
    what = {
        "env_step": "an env step of a rollout worker",
        "update": f"an update of batch {work.batch_size}",
        "draw": "a row drawn in the learner's process",
        "ask": "a call, who asks",
        "do": "a call, who answers",
        "push": f"a block of {work.block_env_steps:,} transitions, with weights in the reply, who pushes",
        "store": "the same, who stores",
        "give": "a row drawn in another process, there",
        "take": "the same, at the learner",
        "send": "a copy of the weights for a shard in a process of its own, who sends",
        "receive": "a copy of the weights for a shard in a process of its own, who gets it",
        "publish": "new weights, at the learner",
    }
    for name, text in what.items():
        table.add_row(name, microseconds(getattr(costs, name)), text)
    return table


def point_table(points: dict[tuple[int, float], Point], costs: Costs, work: Work, cores: int) -> Table:
    table = Table(title=f"the service on {cores} cores, measured and predicted")
    columns = ("workers", "samples/insert", "env steps/s", "updates/s", "predicted", "bound by", "measured / predicted")
    for column in (*columns, "CPU µs/env step: workers", "learner", "driver", "Ray", "waiting: workers", "learner"):
        table.add_column(column, justify="right")
    for (workers, samples), point in points.items():
        bound = bounds(costs, work._replace(samples_per_insert=samples), workers, cores=cores)[0]
        known = [point.cpu_s.get(kind, 0.0) for kind in ("rollout worker", "learner", "driver")]
        rest = sum(point.cpu_s.values()) - sum(known)
        table.add_row(
            str(workers),
            f"{samples:g}",
            f"{point.env_steps_per_s:,.0f}",
            f"{point.updates_per_s:,.0f}",
            f"{bound.env_steps_per_s:,.0f}",
            bound.hop,
            f"{point.env_steps_per_s / bound.env_steps_per_s:.2f}",
            *map(microseconds, [*known, rest]),
            f"{point.waits['worker_stores'] + point.waits['worker_waits']:.0%}",
            f"{point.waits['learner_waits']:.0%}",
        )
    return table


def saturation_table(costs: Costs, work: Work) -> Table:
    table = Table(title="with a core for every process: where each hop is full, by the model")
    for column in ("samples/insert", "shards", "full first", "at env steps/s", "rollout workers", "messages/s", "MB/s"):
        table.add_column(column, justify="right")
    for samples in sorted({samples for _, samples in POINTS}):
        here = work._replace(samples_per_insert=samples)
        for own in (False, True):
            shards = shards_needed(costs, here) if own else 0
            full, rate = bounds(costs, here, MANY, shards)[0]
            workers = saturation(costs, here, shards)[full]
            table.add_row(
                f"{samples:g}",
                f"{shards} of their own" if own else "with the learner",
                full,
                f"{rate:,.0f}",
                f"{workers:.1f}",
                f"{messages(here, shards) * rate:,.0f}",
                f"{network_bytes(here, workers, shards) * rate / 1e6:,.0f}",
            )
    return table


def draw(points: dict[tuple[int, float], Point], costs: Costs, work: Work, cores: int) -> None:
    """The picture: predictions as lines, what was measured as points."""
    figure, axes = plt.subplots(figsize=(9, 5), layout="constrained")
    counts = np.geomspace(1, 64, 49)
    for i, samples in enumerate(sorted({samples for _, samples in points})):
        here = work._replace(samples_per_insert=samples)
        for limit, style, where in ((np.inf, "--", "a core a process"), (cores, "-", f"{cores} cores")):
            rates = [bounds(costs, here, count, cores=limit)[0].env_steps_per_s for count in counts]
            axes.plot(counts, rates, style, color=f"C{i}", label=f"{samples:g} samples/insert, model: {where}")
        mine = {workers: point.env_steps_per_s for (workers, of), point in points.items() if of == samples}
        axes.plot(list(mine), list(mine.values()), "o", color=f"C{i}", label=f"measured on {cores} cores")
    axes.set(xscale="log", yscale="log", xlabel="rollout workers", ylabel="env steps/s")
    axes.set_xticks([1, 2, 4, 8, 16, 32, 64], ["1", "2", "4", "8", "16", "32", "64"])
    axes.minorticks_off()
    ticks = [number * 10**power for power in (4, 5, 6) for number in (1, 2, 5)]
    low, high = axes.get_ylim()
    axes.set_yticks([tick for tick in ticks if low <= tick <= high])
    axes.yaxis.set_major_formatter("{x:,.0f}")
    axes.grid(alpha=0.3)
    figure.legend(loc="outside right upper", fontsize=8)
    figure.savefig(PICTURE, dpi=120)
    plt.close(figure)


def work_of(config: RunConfig) -> Work:
    shape = env_shape(config.env)
    arrays = Learner(config, shape).weights(0.0).arrays
    row = transition_dtype(shape.observation_space)
    frames = estimate_frames(config.block_env_steps, config.steps_per_block, config.n_step)
    packed = packed_dtype(row).itemsize + frames / config.block_env_steps * row["observation"].itemsize
    weights = sum(array.nbytes for array in arrays)
    sizes = (config.batch_size, config.updates_per_call)
    return Work(config.block_env_steps, config.samples_per_insert, *sizes, packed, row.itemsize, weights)


def main(picture: bool) -> None:
    config = RunConfig(**ENDLESS)
    work, cores = work_of(config), psutil.cpu_count() or 1
    costs = measured_costs(config)
    points = {}
    for workers, samples in POINTS:
        points[workers, samples] = measured_point(
            dataclasses.replace(config, workers=workers, samples_per_insert=samples), COUNTED_S
        )
    console = Console(width=200)
    for table in (cost_table(costs, work), point_table(points, costs, work, cores), saturation_table(costs, work)):
        console.print(table)
    floats = work.weights_bytes // np.dtype(np.float32).itemsize
    console.print(learners_table(costs, work, update_seconds(config), sum_seconds(floats)))
    learner = seconds_per_env_step(costs, work, 0)[LEARNER]
    console.print(
        f"{work.packed_bytes:.1f} bytes a transition in a block, {work.row_bytes} in a sample, "
        f"{work.weights_bytes:,} a copy of the weights; the learner's "
        f"{microseconds(learner)} µs per env step are {work.samples_per_insert:g} samples",
        highlight=False,
    )
    if picture:
        draw(points, costs, work, cores)
        console.print(f"drawn: {PICTURE}", highlight=False)
