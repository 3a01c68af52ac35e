"""`make bench-peers`: the same training by shoal and by what a user would take instead, side by side.

Each contest sets the environment, the network, the batch and the samples per insert. Every contender trains in a
process of its own, one at a time, in turn; first each tries several numbers of environments and threads and keeps the
fastest. Then come rates (env steps and updates a second once training has begun) and the time to a threshold: from the
start of the training, environments and Ray being up, to the first evaluation that reaches it. The watch stands still
while the judge plays, and so does the training.
"""

import argparse
import dataclasses
import importlib.util
import json
import os
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from actors.vector_env import env_shape
from learner.config import RunConfig, from_dict
from learner.ray_auth import guard_ray
from sim_core.config import WorldConfig
from tests.benchmarks.contest import Finding, Heat
from tests.benchmarks.timing import ratio, spread

ROOT = Path(__file__).parents[2]
OURS = "shoal"
PEERS = ("Stable-Baselines3", "TorchRL", "RLlib")
SWEEP_S = 6.0


class Contest(NamedTuple):
    """A training that is set; `threshold` of the success rate or mean return, None to measure rates alone."""

    config: RunConfig
    threshold: float | None

    @property
    def title(self) -> str:
        config = self.config
        shape = env_shape(config.env)
        what = f"{config.world.method} {config.world.setup}" if config.env.is_swarm else config.env_id
        sizes = "-".join(map(str, (shape.observation_size, *config.hidden_sizes, shape.num_actions)))
        return f"{what}, {sizes}, batch {config.batch_size}, {config.samples_per_insert:g} samples per insert"


class Style(NamedTuple):
    """How a contender may go about a training."""

    envs: int
    threads: int
    variant: str = ""

    def text(self) -> str:
        return " ".join(filter(None, (f"{self.envs} envs, {self.threads} threads", self.variant)))


class Contender(NamedTuple):
    """Who trains: a module of `contenders`, and the interpreter that has what it needs."""

    module: str
    python: str = sys.executable

    def styles(self, contest: Contest) -> list[Style]:
        if self.module == "shoal":
            return [Style(envs, 1) for envs in (16, 64, 128)]
        if self.module == "sb3":
            kinds = ("", "vectorised") if contest.config.env.is_swarm else ("",)
            return [Style(envs, threads, kind) for kind in kinds for envs in (8, 64, 256) for threads in (1, 2)]
        return [Style(envs, 1) for envs in (16, 64)]


def contests() -> dict[str, Contest]:
    cartpole = from_dict(tomllib.loads((ROOT / "deploy/configs/cartpole.toml").read_text("utf-8")))
    often = {"eval_every_env_steps": 50_000, "eval_episodes": 200, "checkpoint_every_env_steps": 10**9}
    seldom = {"total_env_steps": 10**8, "eval_every_env_steps": 10**9, "checkpoint_every_env_steps": 10**9}
    swarm, wide = RunConfig(), RunConfig(world=WorldConfig(method="in", robots=5, groups=8))
    return {
        "cartpole": Contest(
            dataclasses.replace(cartpole, batch_size=512, n_step=1, **seldom),
            None,
        ),
        "cartpole475": Contest(
            dataclasses.replace(
                cartpole, eval_every_env_steps=5_000, eval_episodes=20, checkpoint_every_env_steps=10**9
            ),
            475.0,
        ),
        "swarm": Contest(
            dataclasses.replace(swarm, **often),
            0.85,
        ),
        "wide": Contest(
            dataclasses.replace(
                wide, hidden_sizes=(256, 256), batch_size=512, samples_per_insert=8.0, n_step=1, **seldom
            ),
            None,
        ),
    }


def contenders(rllib: Path | None, console: Console) -> dict[str, Contender]:
    """Those that can take part; the others are named."""
    found = {OURS: Contender("shoal")}
    for name, module, library in (
        ("Stable-Baselines3", "sb3", "stable_baselines3"),
        ("TorchRL", "torchrl", "torchrl"),
    ):
        if importlib.util.find_spec(library) is None:
            console.print(f"{name}: not installed (the extra `peers`), left out")
        else:
            found[name] = Contender(module)
    if rllib is None:
        console.print("RLlib: no --rllib PYTHON with it, left out")
    else:
        found["RLlib"] = Contender("rllib", str(rllib))
    return found


def run_heat(contender: Contender, heat: Heat) -> Finding:
    """One turn in a process of its own.

    Raises:
      RuntimeError: it fails.
    """
    command = [contender.python, "-m", f"tests.benchmarks.contenders.{contender.module}"]
    threads = {name: str(heat.threads) for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    quiet = {"PYTHONWARNINGS": "ignore", "RL_LOGGING_LEVEL": "ERROR", "RAY_TRAIN_V2_ENABLED": "0"}
    began = dataclasses.replace(heat, began_s=time.time())
    done = subprocess.run(
        [*command, began.to_json()],
        cwd=ROOT,
        env={**os.environ, **threads, **quiet},
        capture_output=True,
        text=True,
        check=False,
        timeout=heat.seconds * 3 + 600,
    )
    if done.returncode:
        raise RuntimeError(f"{contender.module} failed: {done.stderr[-2000:]}")
    return Finding(**json.loads(done.stdout.splitlines()[-1]))


class Entry(NamedTuple):
    """A contender in the style that suits it best."""

    name: str
    contender: Contender
    style: Style

    def run(self, config: RunConfig, seconds: float, threshold: float | None) -> Finding:
        style = self.style
        heat = Heat(config, style.envs, style.threads, seconds, threshold, style.variant)
        return run_heat(self.contender, heat)


def fastest(name: str, contender: Contender, contest: Contest, console: Console) -> Entry:
    """The contender in the style of the most env steps a second."""
    best: tuple[float, Entry] | None = None
    for style in contender.styles(contest):
        entry = Entry(name, contender, style)
        rate = entry.run(contest.config, SWEEP_S, None).env_steps_per_s
        console.print(f"  {name}, {style.text()}: {rate:,.0f} env steps/s")
        if best is None or rate > best[0]:
            best = rate, entry
    assert best is not None
    return best[1]


def rate_table(contest: Contest, found: dict[Entry, list[Finding]]) -> Table:
    table = Table(title=f"{contest.title}: rates, median (lowest … highest)")
    for column in ("contender", "its best", "env steps/s", "updates/s", "samples/insert", "shoal / it"):
        table.add_column(column, justify="left" if column in ("contender", "its best") else "right")
    steps = {entry.name: [finding.env_steps_per_s for finding in findings] for entry, findings in found.items()}
    for entry, findings in found.items():
        against = "" if entry.name == OURS else ratio(steps[OURS], steps[entry.name]).text(1)
        updates = spread([finding.updates_per_s for finding in findings])
        samples = spread([one.updates_per_s * contest.config.batch_size / one.env_steps_per_s for one in findings])
        row = (entry.style.text(), spread(steps[entry.name]).text(), updates.text(), f"{samples.median:.1f}", against)
        table.add_row(entry.name, *row)
    return table


def threshold_table(contest: Contest, found: dict[Entry, list[Finding]], limit_s: float) -> Table:
    table = Table(title=f"{contest.title}: seconds to {contest.threshold:g}, median (lowest … highest)")
    for column in ("contender", "its best", "reached", "seconds", "with start-up", "env steps", "it / shoal"):
        table.add_column(column, justify="left" if column in ("contender", "its best") else "right")
    waits = {entry.name: [seconds_of(finding, limit_s) for finding in findings] for entry, findings in found.items()}
    for entry, findings in found.items():
        seconds = waits[entry.name]
        reached = sum(finding.to_threshold_s is not None for finding in findings)
        least = "" if reached == len(findings) else "≥ "
        whole = spread([one + finding.start_up_s for one, finding in zip(seconds, findings, strict=True)])
        env_steps = spread([finding.env_steps for finding in findings])
        against = "" if entry.name == OURS else least + ratio(seconds, waits[OURS]).text(1)
        table.add_row(
            entry.name,
            entry.style.text(),
            f"{reached} of {len(findings)}",
            least + spread(seconds).text(1),
            least + whole.text(1),
            env_steps.text(),
            against,
        )
    return table


def seconds_of(finding: Finding, limit_s: float) -> float:
    """Time to the threshold, or the limit where it was not reached."""
    return limit_s if finding.to_threshold_s is None else finding.to_threshold_s


def hold(contest: Contest, field: dict[str, Contender], options: argparse.Namespace, console: Console) -> None:
    """Runs one contest and prints its tables."""
    console.print(contest.title)
    entries = [fastest(name, contender, contest, console) for name, contender in field.items()]
    seeds = [dataclasses.replace(contest.config, seed=seed) for seed in range(options.rounds)]
    console.print(rate_table(contest, in_turn(entries, [contest.config] * options.rounds, options.seconds, None)))
    if contest.threshold is not None:
        found = in_turn(entries, seeds, options.limit_s, contest.threshold)
        console.print(threshold_table(contest, found, options.limit_s))


def in_turn(
    entries: list[Entry], rounds: list[RunConfig], seconds: float, threshold: float | None
) -> dict[Entry, list[Finding]]:
    """What each contender found in every round, one after the other, so that the machine drifts for all alike."""
    found: dict[Entry, list[Finding]] = {entry: [] for entry in entries}
    for config in rounds:
        for entry in entries:
            found[entry].append(entry.run(config, seconds, threshold))
    return found


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    known = contests()
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.peers", description=__doc__)
    parser.add_argument("contests", nargs="*", help=f"of {', '.join(known)}; default: all")
    parser.add_argument("--rllib", type=Path, metavar="PYTHON", help="an interpreter with shoal and ray[rllib]")
    parser.add_argument("--only", nargs="+", choices=PEERS, help="the peers beside shoal; default: all")
    parser.add_argument("--rounds", type=int, default=3, help="of every measurement; of the threshold, seeds")
    parser.add_argument("--seconds", type=float, default=15.0, help="that a rate is measured for")
    parser.add_argument("--limit-s", type=float, default=600.0, help="after which a threshold counts as not reached")
    options = parser.parse_args(arguments)
    for name in options.contests:
        if name not in known:
            parser.error(f"no contest {name!r}; there are: {', '.join(known)}")
    if options.rllib is not None and not options.rllib.is_file():
        parser.error(f"--rllib: there is no file {options.rllib}")
    return options


def main() -> int:
    options = parse()
    guard_ray(joins=False)  # for the contenders, which inherit the environment
    console = Console(width=160)
    field = contenders(options.rllib, console)
    if options.only:
        field = {name: contender for name, contender in field.items() if name in (OURS, *options.only)}
    for name, contest in contests().items():
        if not options.contests or name in options.contests:
            hold(contest, field, options, console)
    return 0


if __name__ == "__main__":
    sys.exit(main())
