"""The strip of frames, read back from the pixels of the PNG."""

from __future__ import annotations

from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from matplotlib.colors import to_rgb

from actors.evaluation.trajectory import Episode
from dashboards.figures.film_strip import FAILURE, FRAME_PX, GAP_PX, HEAD_PX, SUCCESS, episode_strip_png, frame_steps
from sim_core.config import WorldConfig
from sim_core.render import GROUP_COLOURS, colour_rgb, to_pixels


def draw(episode: Episode, config: WorldConfig, path: Path, frames: int = 6) -> np.ndarray:
    episode_strip_png(episode, config, path, frames)
    return np.rint(matplotlib.image.imread(path)[..., :3] * 255).astype(int)


def has_colour(image: np.ndarray, colour: str) -> bool:
    return bool((np.abs(image - np.array(to_rgb(colour)) * 255).max(axis=-1) < 6).any())


def test_steps_are_evenly_spaced_with_both_ends():
    assert frame_steps(251, 6).tolist() == [0, 50, 100, 150, 200, 250]
    assert frame_steps(3, 6).tolist() == [0, 1, 2]
    assert frame_steps(1, 6).tolist() == [0]


def test_each_frame_shows_its_step(episode: Episode, config: WorldConfig, tmp_path: Path):
    image = draw(episode, config, tmp_path / "strip.png")
    steps = frame_steps(len(episode.position), 6)
    assert image.shape[1] == 6 * (FRAME_PX + GAP_PX) + GAP_PX
    for place, step in enumerate(steps):
        pixels = to_pixels(episode.position[step], config, FRAME_PX).astype(int)
        for robot, (column, row) in enumerate(pixels):
            near_learner = np.hypot(*(pixels[robot] - pixels[episode.learner])) < 10
            if robot != episode.learner and near_learner:
                continue
            colour = "#000000" if robot == episode.learner else GROUP_COLOURS[robot // config.robots]
            seen = image[HEAD_PX + row, GAP_PX + place * (FRAME_PX + GAP_PX) + column]
            assert np.abs(seen - colour_rgb(colour)).max() <= 40, (step, robot, seen)


def test_the_outcome_is_written_above_the_last_frame(
    episode: Episode, failed: Episode, config: WorldConfig, tmp_path: Path
):
    good = draw(episode, config, tmp_path / "good.png")[:HEAD_PX]
    bad = draw(failed, config, tmp_path / "bad.png")[:HEAD_PX]
    last = 5 * (FRAME_PX + GAP_PX)
    assert has_colour(good[:, last:], SUCCESS) and not has_colour(good, FAILURE)
    assert has_colour(bad[:, last:], FAILURE) and not has_colour(bad, SUCCESS)
    assert not has_colour(bad[:, :last], FAILURE)


def test_file_is_small(tmp_path: Path, episode: Episode, config: WorldConfig):
    draw(episode, config, tmp_path / "strip.png")
    assert (tmp_path / "strip.png").stat().st_size < 150 * 1024


def test_short_episode_has_fewer_frames(episode: Episode, config: WorldConfig, tmp_path: Path):
    image = draw(episode._replace(position=episode.position[:3]), config, tmp_path / "strip.png")
    assert image.shape[1] == 3 * (FRAME_PX + GAP_PX) + GAP_PX


def test_refuses_one_frame(episode: Episode, config: WorldConfig, tmp_path: Path):
    with pytest.raises(ValueError, match="at least 2"):
        episode_strip_png(episode, config, tmp_path / "strip.png", frames=1)
