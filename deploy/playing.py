"""`shoal evaluate` and `shoal watch`: a trained policy at work."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from rich.console import Console

from actors.evaluator import record_episode
from actors.network import WeightsSnapshot
from actors.trajectory import save_episodes
from actors.vector_env import env_shape
from dashboards.strip import episode_strip_png
from deploy.artifacts import foreign_animation, write_player, write_video
from deploy.options import Evaluate, Watch, ray_address
from deploy.tables import evaluation_table
from learner.checkpoint import newest_valid
from learner.config import RunConfig
from learner.policy_file import read_policy
from learner.ray_edge import evaluate_in_tasks
from learner.results import summarise
from learner.run_folder import RunFolder, find_run
from sim_core.checks import require
from sim_core.outcomes import OUTCOME_NAMES


def _load(folder: RunFolder, config: RunConfig) -> WeightsSnapshot:
    checkpoint, skipped = newest_valid(folder.checkpoints)
    for reason in skipped:
        Console(stderr=True).print(f"skipped: {reason}", highlight=False)
    return read_policy(checkpoint, config, env_shape(config.env))


def evaluate(command: Evaluate) -> int:
    """Prints a run's rates; returns the exit code."""
    folder = find_run(command.run, command.runs_dir)
    config = _on_setup(folder.config(), command.robots, command.groups)
    weights = _load(folder, config)
    seeds = list(range(command.first_seed, command.first_seed + command.episodes))
    evaluation = summarise(evaluate_in_tasks(config.env, weights, seeds, ray_address(command.address)))
    title = f"{config.world.method} {config.world.setup}" if config.env.is_swarm else config.env_id
    Console().print(evaluation_table(evaluation, title))
    return 0


def _on_setup(config: RunConfig, robots: int | None, groups: int | None) -> RunConfig:
    if robots is None and groups is None:
        return config
    require(config.env.is_swarm, f"--robots and --groups apply to our own environment, not to {config.env_id}")
    world = dataclasses.replace(
        config.world,
        robots=config.world.robots if robots is None else robots,
        groups=config.world.groups if groups is None else groups,
    )
    return dataclasses.replace(config, world=world)


def watch(command: Watch) -> int:
    """Renders an episode; returns the exit code."""
    folder = find_run(command.run, command.runs_dir)
    config = folder.config()
    weights = _load(folder, config)
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
        write_player(store, path, f"{config.world.method} {config.world.setup}")
    elif command.format == "mp4":
        write_video(store, path)
    else:
        episode_strip_png(episode, config.world, path)
    Console().print(f"{len(episode.action) - 1} env steps, outcome {OUTCOME_NAMES[episode.outcome]}", highlight=False)
