"""Artifacts of a finished run, in its folder and in MLflow: config, learning curve, animation and policy."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

from actors.evaluation.evaluator import record_episode, record_frames
from actors.evaluation.trajectory import Episode, load_episodes, save_episodes
from actors.policy.policy import WeightsSnapshot
from actors.rollout.vector_env import env_shape
from actors.service.fault_policy import first_line
from actors.storage.atomic_write import replacing_file
from dashboards.figures.learning_curve import learning_curve_png
from dashboards.figures.video import check_video_packages, episode_frames, write_mp4
from dashboards.pages.player import player_html
from deploy.runs.folders import write_text
from deploy.runs.learning_curve import curve_points
from learner.config import RunConfig
from learner.file_names import CONFIG
from learner.run import RunResult, Step
from learner.run_folder import RunFolder
from learner.tracking.journal import Row
from learner.tracking.tracked_run import TrackedRun
from learner.training.evaluation_summary import as_metrics, score
from sim_core.checks import ConfigError
from sim_core.outcomes import Outcome

EPISODES_TRIED = 10
"""The animation shows the first success among this many episodes."""
VIDEO_SIZE_PX = 480


def artifact_steps(
    folder: RunFolder,
    config: RunConfig,
    tracker: TrackedRun,
    message: Callable[[str], None],
    result: RunResult,
    rows: list[Row],
) -> list[Step]:
    """The steps of a run's end that write its artifacts and upload them; `message` tells if one is left out."""
    weights, evaluation = result.weights, result.evaluation
    assert weights is not None and evaluation is not None

    def log_files() -> None:
        message("logging curve, animation and policy")
        for path in _write_files(folder, config, result, weights, rows, message):
            tracker.log_artifact(path)

    def log_policy() -> None:
        tracker.log_policy(weights, config, env_shape(config.env), score(evaluation))

    return [Step("the artifacts", log_files), Step("the policy", log_policy)]


def _write_files(
    folder: RunFolder,
    config: RunConfig,
    result: RunResult,
    weights: WeightsSnapshot,
    rows: list[Row],
    message: Callable[[str], None],
) -> list[Path]:
    """Writes the curve, the animation and the rates of every setup; returns all files to upload."""
    folder.artifacts.mkdir(exist_ok=True)
    written = [folder.path / CONFIG, _curve(folder, config, [*rows, _last_row(result)])]
    if config.env.is_swarm:
        written += _swarm_animation(folder, config, weights)
    else:
        path = folder.artifacts / "episode.mp4"
        try:
            check_video_packages()
            foreign_animation(config, weights, config.final_eval_first_seed, path)
            written.append(path)
        except ConfigError as error:
            message(f"no animation: {error}")
    return written + ([_setups(folder, result)] if result.by_setup else [])


def _setups(folder: RunFolder, result: RunResult) -> Path:
    """Writes the rates of every setup as `setups.csv`."""
    path = folder.artifacts / "setups.csv"
    rows = [{"setup": setup} | as_metrics(evaluation) for setup, evaluation in result.by_setup.items()]
    with replacing_file(path) as partial, open(partial, "w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    return path


def _last_row(result: RunResult) -> Row:
    """The final evaluation as a row, for the curve's last point."""
    assert result.evaluation is not None
    metrics = {f"eval/{name}": value for name, value in as_metrics(result.evaluation).items()}
    return Row(result.env_steps, 0, metrics)


def _curve(folder: RunFolder, config: RunConfig, rows: list[Row]) -> Path:
    path = folder.artifacts / "learning_curve.png"
    points = curve_points(rows)
    is_share = points[0].failures is not None
    learning_curve_png(points, path, config.title, "success rate" if is_share else "mean return", is_share)
    return path


def _swarm_animation(folder: RunFolder, config: RunConfig, weights: WeightsSnapshot) -> list[Path]:
    episode = _first_success(config, weights)
    store, page = folder.artifacts / "episode.zarr", folder.artifacts / "episode.html"
    save_episodes(store, [episode], config.world)
    write_player(store, page, f"{config.world.method_name} {config.world.setup}")
    return [store, page]


def _first_success(config: RunConfig, weights: WeightsSnapshot) -> Episode:
    episodes = (record_episode(config.env, weights, config.final_eval_first_seed + i) for i in range(EPISODES_TRIED))
    first = next(episodes)
    if first.outcome == Outcome.GOAL:
        return first
    return next((episode for episode in episodes if episode.outcome == Outcome.GOAL), first)


def write_player(store: Path, page: Path, title: str) -> None:
    """Writes the player of the first episode in the zarr store `store` as HTML to `page`."""
    episodes, world = load_episodes(store)
    write_text(page, player_html(episodes[0], world, title))


def write_video(store: Path, path: Path) -> None:
    """Writes the first episode in the zarr store `store` as MP4 to `path`, at the speed of simulated time."""
    episodes, world = load_episodes(store)
    write_mp4(episode_frames(episodes[0], world, VIDEO_SIZE_PX), path, 1 / world.time_step_s)


def foreign_animation(config: RunConfig, weights: WeightsSnapshot, seed: int, path: Path) -> None:
    """Writes one episode of a Gymnasium environment as MP4.

    Raises:
      ConfigError: it cannot be drawn, or its images cannot be encoded.
    """
    frames, frames_per_s = record_frames(config.env, weights, seed)
    try:
        write_mp4(frames, path, frames_per_s)
    except OSError as error:
        raise ConfigError(f"the images of env_id {config.env_id!r} cannot be encoded: {first_line(error)}") from error
