"""`shoal watch`: one episode of a policy as a page, a video or a strip of frames; a live page; a page to drive on."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path

from actors.evaluation.conditions import parse_condition, world_under
from actors.evaluation.evaluator import record_episode
from actors.evaluation.trajectory import Episode, save_episodes
from actors.rollout.env_guard import env_guard
from dashboards.figures.film_strip import episode_strip_png
from dashboards.figures.video import check_video_packages
from deploy.console.serving import serve_until_interrupted
from deploy.console.terminal import plain_console
from deploy.drive import drive_server, driven_world, load_driven
from deploy.live import live_server
from deploy.options.results import Watch
from deploy.runs.artifacts import foreign_animation, write_player, write_video
from deploy.runs.folders import make_folder
from deploy.runs.policy_lookup import find_policy
from learner.cluster_options import DEADLINE_S
from learner.run_folder import find_run
from sim_core.checks import require
from sim_core.config import WorldConfig
from sim_core.outcomes import OUTCOME_NAMES


def run(command: Watch) -> int:
    """Renders an episode, or serves the newest policy's episodes; returns the exit code.

    Raises:
      ConfigError: there is no such run or policy, its environment cannot be shown in this way, or the port is taken.
    """
    folder = find_run(command.run, command.runs_dir)
    config = folder.config()
    if condition := parse_condition(command.under):
        require(config.env.is_swarm, f"--under sets conditions of our own environment, not of {config.env_id}")
        config = dataclasses.replace(config, world=world_under(config.world, condition))
    require(config.env.is_swarm or not command.drive, f"--drive plays our own environment only, not {config.env_id}")
    if command.live:
        return serve_until_interrupted(live_server(folder, config, command.seed, command.port))
    if command.format == "mp4":
        check_video_packages()
    weights = find_policy(folder, config, command.checkpoint)
    if command.drive and command.format == "html":
        return serve_until_interrupted(drive_server(folder, config.world, weights, command.seed, command.port))
    played = "driven" if command.drive else "episode"
    path = command.out or folder.artifacts / f"{played}-{command.seed}.{command.format}"
    make_folder(path.parent, "--out" if command.out else "without --out, the run's folder")
    if command.drive:
        _render_swarm(driven_world(config.world), load_driven(folder, config.world, command.seed), command, path)
    elif config.env.is_swarm:
        _render_swarm(config.world, record_episode(config.env, weights, command.seed), command, path)
    else:
        require(command.format == "mp4", f"{config.env_id} can only be watched as a video; use --format mp4")
        with env_guard(DEADLINE_S):
            foreign_animation(config, weights, command.seed, path)
    plain_console().print(str(path), soft_wrap=True)
    return 0


def _render_swarm(world: WorldConfig, episode: Episode, command: Watch, path: Path) -> None:
    """Writes the episode to `path`; in the run's artifacts it is kept as zarr, too."""
    with tempfile.TemporaryDirectory(prefix="shoal-") as folder:
        store = Path(folder) / "episode.zarr" if command.out else path.with_suffix(".zarr")
        save_episodes(store, [episode], world)
        if command.format == "html":
            write_player(store, path, f"{world.method_name} {world.setup}")
        elif command.format == "mp4":
            write_video(store, path)
        else:
            episode_strip_png(episode, world, path)
    plain_console().print(f"{len(episode.action) - 1} env steps, outcome {OUTCOME_NAMES[episode.outcome]}")
