"""Who takes part in `tests.benchmarks.peers`, in what trainings, and how one turn is run."""

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

from actors.rollout.vector_env import env_shape
from learner.config import RunConfig, from_dict
from sim_core.config import WorldConfig
from tests.benchmarks.contest import Finding, Heat

ROOT = Path(__file__).parents[2]
OURS = "shoal"
LIMIT = "the limit"
TWO_WORKERS = "2 workers"
"""A style of ours: rollout workers beside the learner; where simulating is what takes time, one is too few."""
SHORT_BLOCKS = "short blocks"
"""A style of ours: blocks and calls of updates as short as in the presets (`learner.presets`). The learner begins
earlier, and more messages are sent."""
ONE_PROCESS = "one process"
"""A style of ours: without Ray, which takes seconds to start."""


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
        steps = config.world.decision_interval_steps
        often = f", a decision every {steps} steps" if steps > 1 else ""
        return f"{what}{often}, {sizes}, batch {config.batch_size}, {config.samples_per_insert:g} samples per insert"


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
        if self.module == "limit":
            return [Style(envs, 1) for envs in (16, 64, 128)]
        if self.module == "shoal":
            placed = ("", TWO_WORKERS, ONE_PROCESS)
            kinds = [", ".join(filter(None, (place, blocks))) for place in placed for blocks in ("", SHORT_BLOCKS)]
            return [Style(envs, 1, kind) for kind in kinds for envs in (64, 128, 256)]
        if self.module == "sb3":
            kinds = ("", "vectorised") if contest.config.env.is_swarm else ("",)
            return [Style(envs, threads, kind) for kind in kinds for envs in (8, 64, 256) for threads in (1, 2)]
        return [Style(envs, 1) for envs in (16, 64)]


def contests() -> dict[str, Contest]:
    cartpole = from_dict(tomllib.loads((ROOT / "deploy/configs/cartpole.toml").read_text("utf-8")))
    often = {"eval_every_env_steps": 10_000, "eval_episodes": 200, "checkpoint_every_env_steps": 10**9}
    seldom = {"total_env_steps": 10**8, "eval_every_env_steps": 10**9, "checkpoint_every_env_steps": 10**9}
    swarm = RunConfig()
    spaced = RunConfig(world=WorldConfig(decision_interval_steps=4))  # as the preset `best` decides
    wide = RunConfig(world=WorldConfig(method="in", robots=5, groups=8))
    return {
        "cartpole": Contest(
            dataclasses.replace(cartpole, batch_size=512, n_step=1, **seldom),
            None,
        ),
        "cartpole475": Contest(
            dataclasses.replace(cartpole, **seldom | {"eval_every_env_steps": 5_000, "eval_episodes": 20}),
            475.0,
        ),
        "swarm": Contest(
            dataclasses.replace(spaced, **often),
            0.85,
        ),
        "swarm-every-step": Contest(
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
    found = {OURS: Contender("shoal"), LIMIT: Contender("limit")}
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
