"""`shoal evaluate`: success and failure rates of a trained policy or a baseline on fixed seeds."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from actors.evaluation.evaluation_store import StoredEvaluation, refuse_existing, save_evaluation
from actors.evaluation.evaluator import Candidate, record_episode
from actors.evaluation.trajectory import save_episodes
from actors.policy.baselines import Baseline, check_exists
from actors.rollout.vector_env import EnvSpec
from actors.rollout.worker import join_stats
from actors.service.messages import EpisodeStats
from deploy.console.summary_tables import compared, evaluation_table, setups_table
from deploy.console.terminal import plain_console
from deploy.options.results import Evaluate
from deploy.options.training import ray_address
from deploy.runs.folders import make_folder
from deploy.runs.policy_lookup import find_policy
from learner.presets import preset_config
from learner.ray_backend.cluster import evaluate_in_tasks
from learner.run_folder import find_run
from learner.training.evaluation_summary import summarise
from sim_core import ENV_ID
from sim_core.checks import require
from sim_core.config import WorldConfig
from sim_core.outcomes import Outcome
from sim_core.plugins import SCENES

SCENE_SETTINGS = ("scene", "arena_radius_m", "start_spacing_m", "start_jitter_m")
"""World settings, beside robots and groups, that decide where episodes start."""


class Target(NamedTuple):
    """What is evaluated: the environment, the policy or baseline, its name and number of updates, and a title."""

    spec: EnvSpec
    candidate: Candidate
    name: str
    updates: int
    title: str


def run(command: Evaluate) -> int:
    """Prints the rates, and stores what `--out` and `--record` ask for; returns the exit code.

    Raises:
      ConfigError: there is no such run or policy, a flag does not apply to it, or a file to write exists.
    """
    targets = _targets(command)
    if len(targets) > 1:
        return _compare(command, targets)
    target = targets[0]
    if command.out is not None:
        _check_outputs(command.out, command.record, target.spec)
    seeds = list(range(command.first_seed, command.first_seed + command.episodes))
    played = _play(command, target, seeds)
    stats = join_stats(played)
    if len(played) > 1:
        setups = (world.setup for world in target.spec.worlds)
        plain_console().print(setups_table(dict(zip(setups, map(summarise, played), strict=True))))
    kind = "episodes" if isinstance(target.candidate, Baseline) else "greedy episodes"
    plain_console().print(evaluation_table(summarise(stats), target.title, kind))
    if command.out is not None:
        _record(command.out, target, seeds[: command.record])
        seed = np.array(seeds, np.int64)
        save_evaluation(command.out, StoredEvaluation(target.spec, target.name, target.updates, seed, stats))
        plain_console().print(str(command.out), soft_wrap=True)
    return 0


def _play(command: Evaluate, target: Target, seeds: list[int]) -> list[EpisodeStats]:
    """The player's episodes in each of its setups, from one start of Ray."""
    specs = [target.spec.of_setup(world) for world in target.spec.worlds]
    return evaluate_in_tasks(specs, target.candidate, seeds, ray_address(command.address))


def _targets(command: Evaluate) -> list[Target]:
    """The players in the order of the command; beside runs, baselines play in the world of the first run."""
    names = list(Baseline)
    trained = {name: _trained(command, name) for name in command.run if name not in names}
    first = next(iter(trained.values()), None)
    spec = _baseline_spec(command) if first is None else first.spec
    baselines = {name: _baseline(spec, Baseline(name)) for name in command.run if name in names}
    return [(trained | baselines)[name] for name in command.run]


def _baseline_spec(command: Evaluate) -> EnvSpec:
    method = command.method or "sensor"
    default = preset_config(command.preset, method).world if command.preset else WorldConfig(method=method)
    return EnvSpec(ENV_ID, _resized(default, command))


def _baseline(spec: EnvSpec, baseline: Baseline) -> Target:
    check_exists(baseline, spec.world)
    return Target(spec, baseline, str(baseline), 0, f"{baseline}, {spec.world.method_name} {spec.world.setup}")


def _compare(command: Evaluate, targets: list[Target]) -> int:
    """Prints the players' success rates and their paired differences to the first one; returns the exit code.

    Raises:
      ConfigError: their episodes do not start alike.
    """
    first, seeds = targets[0], list(range(command.first_seed, command.first_seed + command.episodes))
    for target in targets:
        require(target.spec.is_swarm, f"{target.name} plays {target.spec.env_id}, whose episodes have no outcomes")
        require(
            _start_scenes(target.spec) == _start_scenes(first.spec),
            f"the episodes of {target.name} and {first.name} do not start alike: their setups or scenes differ; name "
            "one setup for all with --robots and --groups",
        )
    table = Table(title=f"{command.episodes} episodes a setup; differences to {first.name} are paired")
    for name in ("setup", "player", "success rate", "95 % interval", "difference", "95 % interval", "sign test"):
        table.add_column(name, justify="left" if name in ("setup", "player") else "right")
    played = [_play(command, target, seeds) for target in targets]
    for i, world in enumerate(first.spec.worlds):
        goals = list[NDArray[np.bool_]]()
        for target, stats in zip(targets, played, strict=True):
            goals.append(stats[i].outcome == int(Outcome.GOAL))
            table.add_row(*compared(world.setup if target is first else "", target.name, goals))
        table.add_section()
    plain_console().print(table)
    return 0


def _start_scenes(spec: EnvSpec) -> list[tuple[object, ...]]:
    """What decides where robots start and where their goals are, beside the seed, of every setup."""
    return [
        (*(getattr(world, name) for name in SCENE_SETTINGS), world.source(SCENES), world.group_sizes)
        for world in spec.worlds
    ]


def _trained(command: Evaluate, run: str) -> Target:
    for name in ("method", "preset"):
        require(
            getattr(command, name) is None,
            f"--{name} is for the baselines {', '.join(Baseline)}; the run {run!r} has a {name} of its own",
        )
    folder = find_run(run, command.runs_dir)
    config = folder.config()
    require(
        config.env.is_swarm or (command.robots is None and command.groups is None),
        f"--robots and --groups apply to our own environment, not to {config.env_id}",
    )
    if command.robots is not None or command.groups is not None:
        config = dataclasses.replace(config, world=_resized(config.world, command), setups=())
    require(
        command.out is None or not config.setups,
        f"--out stores the episodes of one setup, and {run!r} has learned {len(config.env.worlds)}: name one "
        "with --robots and --groups",
    )
    weights = find_policy(folder, config, command.checkpoint)
    return Target(config.env, weights, folder.path.name, weights.version, config.title)


def _resized(world: WorldConfig, command: Evaluate) -> WorldConfig:
    """The world with the robots and groups that the command asks for."""
    return dataclasses.replace(
        world,
        robots=world.robots if command.robots is None else command.robots,
        groups=world.groups if command.groups is None else command.groups,
    )


def episodes_path(out: Path) -> Path:
    """Where `--record` writes trajectories: `FILE-episodes.zarr` beside the results."""
    return out.with_name(f"{out.stem}-episodes{out.suffix}")


def _check_outputs(out: Path, record: int, spec: EnvSpec) -> None:
    refuse_existing(out)
    if record:
        require(spec.is_swarm, f"--record applies to our own environment, not to {spec.env_id}")
        refuse_existing(episodes_path(out))
    make_folder(out.parent, "the folder of --out,")


def _record(out: Path, target: Target, seeds: list[int]) -> None:
    if seeds:
        episodes = [record_episode(target.spec, target.candidate, seed) for seed in seeds]
        save_episodes(episodes_path(out), episodes, target.spec.world)
        plain_console().print(str(episodes_path(out)), soft_wrap=True)
