"""`shoal evaluate` and `shoal watch`: a trained policy, or a baseline, at work."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console

from actors.evaluation.evaluation_store import StoredEvaluation, refuse_existing, save_evaluation
from actors.evaluation.evaluator import Candidate, record_episode
from actors.evaluation.trajectory import save_episodes
from actors.policy.baselines import Baseline
from actors.policy.network import WeightsSnapshot
from actors.rollout.vector_env import EnvSpec
from dashboards.figures.film_strip import episode_strip_png
from dashboards.figures.video import check_video_packages
from deploy.console.summary_tables import evaluation_table
from deploy.live import watch_live
from deploy.options.results import Evaluate, Watch
from deploy.options.training import ray_address
from deploy.runs.artifacts import foreign_animation, write_player, write_video
from deploy.runs.folders import make_folder
from deploy.runs.policy_lookup import find_policy
from learner.config import RunConfig
from learner.presets import preset_config
from learner.ray_backend.cluster import evaluate_in_tasks
from learner.run_folder import find_run
from learner.training.evaluation_summary import summarise
from sim_core import ENV_ID
from sim_core.checks import require
from sim_core.config import WorldConfig
from sim_core.outcomes import OUTCOME_NAMES


class Entry(NamedTuple):
    """What `shoal evaluate` plays: where, with what, and what it is called."""

    spec: EnvSpec
    candidate: Candidate
    player: str
    updates: int
    title: str


def evaluate(command: Evaluate) -> int:
    """Prints the rates of a run's policy or a baseline, and stores what `--out` asks for; returns the exit code."""
    entry = _baseline_entry(command) if command.run in list(Baseline) else _run_entry(command)
    if command.out is not None:
        _check_outputs(command.out, command.record, entry.spec)
    seeds = list(range(command.first_seed, command.first_seed + command.episodes))
    stats = evaluate_in_tasks(entry.spec, entry.candidate, seeds, ray_address(command.address))
    kind = "episodes" if isinstance(entry.candidate, Baseline) else "greedy episodes"
    Console().print(evaluation_table(summarise(stats), entry.title, kind))
    if command.out is not None:
        _record(command.out, entry, seeds[: command.record])
        seed = np.array(seeds, np.int64)
        save_evaluation(command.out, StoredEvaluation(entry.spec, entry.player, entry.updates, seed, stats))
        Console().print(str(command.out), highlight=False, soft_wrap=True)
    return 0


def _baseline_entry(command: Evaluate) -> Entry:
    baseline = Baseline(command.run)
    method = command.method or "sensor"
    default = preset_config(command.preset, method).world if command.preset else WorldConfig(method=method)
    world = _on_setup(default, command)
    title = f"{baseline}, {world.method_name} {world.setup}"
    return Entry(EnvSpec(ENV_ID, world), baseline, str(baseline), 0, title)


def _run_entry(command: Evaluate) -> Entry:
    for name in ("method", "preset"):
        require(
            getattr(command, name) is None,
            f"--{name} is for the baselines {', '.join(Baseline)}; the run {command.run!r} has a {name} of its own",
        )
    folder = find_run(command.run, command.runs_dir)
    config = folder.config()
    resized = command.robots is not None or command.groups is not None
    require(
        config.env.is_swarm or not resized,
        f"--robots and --groups apply to our own environment, not to {config.env_id}",
    )
    config = dataclasses.replace(config, world=_on_setup(config.world, command))
    weights = find_policy(folder, config, command.checkpoint)
    title = f"{config.world.method_name} {config.world.setup}" if config.env.is_swarm else config.env_id
    return Entry(config.env, weights, folder.path.name, weights.version, title)


def _on_setup(world: WorldConfig, command: Evaluate) -> WorldConfig:
    return dataclasses.replace(
        world,
        robots=world.robots if command.robots is None else command.robots,
        groups=world.groups if command.groups is None else command.groups,
    )


def episodes_path(out: Path) -> Path:
    """Where `--record` writes trajectories: beside the results, `FILE-episodes.zarr`."""
    return out.with_name(f"{out.stem}-episodes{out.suffix}")


def _check_outputs(out: Path, record: int, spec: EnvSpec) -> None:
    refuse_existing(out)
    if record:
        require(spec.is_swarm, f"--record applies to our own environment, not to {spec.env_id}")
        refuse_existing(episodes_path(out))
    make_folder(out.parent, "the folder of --out,")


def _record(out: Path, entry: Entry, seeds: list[int]) -> None:
    if seeds:
        episodes = [record_episode(entry.spec, entry.candidate, seed) for seed in seeds]
        save_episodes(episodes_path(out), episodes, entry.spec.world)
        Console().print(str(episodes_path(out)), highlight=False, soft_wrap=True)


def watch(command: Watch) -> int:
    """Renders an episode, or goes on playing the newest policy; returns the exit code."""
    folder = find_run(command.run, command.runs_dir)
    config = folder.config()
    if command.live:
        return watch_live(folder, config, command)
    if command.format == "mp4":
        check_video_packages()
    weights = find_policy(folder, config, command.checkpoint)
    path = command.out or folder.artifacts / f"episode-{command.seed}.{command.format}"
    path.parent.mkdir(parents=True, exist_ok=True)
    if config.env.is_swarm:
        _watch_swarm(config, weights, command, folder.artifacts, path)
    else:
        require(command.format == "mp4", f"{config.env_id} can only be watched as a video; use --format mp4")
        made = foreign_animation(config, weights, command.seed, path)
        require(bool(made), f"{config.env_id} cannot be rendered to images (no rgb_array mode)")
    Console().print(str(path), highlight=False, soft_wrap=True)
    return 0


def _watch_swarm(config: RunConfig, weights: WeightsSnapshot, command: Watch, artifacts: Path, path: Path) -> None:
    store = artifacts / f"episode-{command.seed}.zarr"
    store.parent.mkdir(parents=True, exist_ok=True)
    episode = record_episode(config.env, weights, command.seed)
    save_episodes(store, [episode], config.world)
    if command.format == "html":
        write_player(store, path, f"{config.world.method_name} {config.world.setup}")
    elif command.format == "mp4":
        write_video(store, path)
    else:
        episode_strip_png(episode, config.world, path)
    Console().print(f"{len(episode.action) - 1} env steps, outcome {OUTCOME_NAMES[episode.outcome]}", highlight=False)
