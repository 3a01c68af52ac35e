"""Videos, decoded by FFmpeg and compared with their frames."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import imageio_ffmpeg  # type: ignore[import-untyped]
import numpy as np
import pytest

from actors.evaluation.trajectory import Episode
from dashboards.figures.video import episode_frames, write_mp4
from sim_core.config import WorldConfig
from sim_core.render import GROUP_COLOURS, colour_rgb, to_pixels


def decode(path: Path) -> tuple[np.ndarray, str]:
    """Frames `[num_frames, height, width, 3]` and FFmpeg's description of the video."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    description = done.stderr.decode().split("Output #0")[0]
    size = re.search(r", (\d\d+)x(\d\d+)[, ]", description)
    assert size is not None, description
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, int(size[2]), int(size[1]), 3), description


def flat(red: int, green: int, blue: int, height: int = 64, width: int = 96) -> np.ndarray:
    return np.full((height, width, 3), (red, green, blue), np.uint8)


def test_the_video_shows_every_state_with_every_robot_in_its_colour(
    episode: Episode, config: WorldConfig, tmp_path: Path
):
    short = episode._replace(position=episode.position[:40])
    write_mp4(episode_frames(short, config, 640), tmp_path / "film.mp4", 20.0)
    frames, description = decode(tmp_path / "film.mp4")
    assert frames.shape == (40, 640, 640, 3)
    for wanted in ("h264", "yuv420p", " 20 fps"):
        assert wanted in description
    palette = np.stack([colour_rgb(colour) for colour in (*GROUP_COLOURS, "#000000", "#FFFFFF")]).astype(int)
    for step in (0, 20, 39):
        pixels = to_pixels(short.position[step], config, 640).astype(int)
        for robot, (column, row) in enumerate(pixels):
            seen = frames[step, row, column].astype(int)
            nearest = int(np.abs(palette - seen).sum(axis=1).argmin())
            expected = len(GROUP_COLOURS) if robot == short.learner else robot // config.robots
            assert nearest == expected, (step, robot, seen)


def test_colours_and_order_are_kept(tmp_path: Path):
    colours = [(200, 30, 40), (20, 160, 60), (30, 60, 190)]
    write_mp4([flat(*colour) for colour in colours], tmp_path / "film.mp4", 10.0)
    frames, _ = decode(tmp_path / "film.mp4")
    np.testing.assert_allclose(frames.mean(axis=(1, 2)), colours, atol=8)


def test_odd_edges_are_padded_without_scaling(tmp_path: Path):
    image = flat(255, 255, 255, 63, 95)
    image[:, :40] = (0, 0, 0)
    write_mp4([image] * 3, tmp_path / "film.mp4", 10.0)
    frames, _ = decode(tmp_path / "film.mp4")
    assert frames.shape == (3, 64, 96, 3)
    assert frames[1, 63, 20].max() < 25
    assert frames[1, 30, 38].max() < 60 and frames[1, 30, 41].min() > 195
    assert frames[1, 63, 95].min() > 230


def test_a_failing_source_leaves_the_older_video(tmp_path: Path):
    def broken() -> Iterator[np.ndarray]:
        yield flat(1, 2, 3)
        raise RuntimeError("the source broke")

    path = tmp_path / "film.mp4"
    write_mp4([flat(200, 30, 40)] * 2, path, 10.0)
    before = path.read_bytes()
    with pytest.raises(RuntimeError, match="the source broke"):
        write_mp4(broken(), path, 10.0)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["film.mp4"]


def test_refuses_frames_that_differ(tmp_path: Path):
    with pytest.raises(ValueError, match="must all be"):
        write_mp4([flat(0, 0, 0), flat(0, 0, 0, height=32)], tmp_path / "film.mp4", 10.0)
    assert list(tmp_path.iterdir()) == []


def test_refuses_no_frames_and_other_formats(tmp_path: Path):
    with pytest.raises(ValueError, match="no frames"):
        write_mp4([], tmp_path / "film.mp4", 10.0)
    with pytest.raises(ValueError, match="must end in .mp4"):
        write_mp4([flat(0, 0, 0)], tmp_path / "film.gif", 10.0)
    assert list(tmp_path.iterdir()) == []
