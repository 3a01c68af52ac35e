"""Episodes as MP4 videos."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from actors.evaluation.trajectory import Episode
from actors.storage.atomic_write import replacing_file
from sim_core.checks import require_packages
from sim_core.config import WorldConfig
from sim_core.render import draw_world

CRF = "20"
"""x264's constant rate factor: 18 looks lossless, 23 is the default; larger values give smaller, worse videos."""


def check_video_packages() -> None:
    """Raises ConfigError unless the packages that encode videos and render Gymnasium's environments are there."""
    require_packages("a video", "video", "imageio_ffmpeg", "pygame")


def episode_frames(episode: Episode, config: WorldConfig, size_px: int = 480) -> Iterator[NDArray[np.uint8]]:
    """Draws the T + 1 states of `episode`, each as `[size_px, size_px, 3]` uint8 RGB."""
    for position in episode.position:
        yield draw_world(position, episode.goal, episode.learner, config, size_px)


def write_mp4(frames: Iterable[NDArray[np.uint8]], path: Path, frames_per_s: float) -> None:
    """Writes an H.264 video that every browser plays (yuv420p); `path` appears once the video is complete.

    Args:
      frames: `[height, width, 3]` uint8 RGB, all of one shape; an odd height or width is padded by one line.
      path: ends in `.mp4`; an existing file is replaced.
      frames_per_s: 1 / time_step_s plays at the speed of simulated time.

    Raises:
      ValueError: there are no frames, they differ in shape or are not uint8, or `path` does not end in `.mp4`.
    """
    if path.suffix != ".mp4":
        raise ValueError(f"{path} must end in .mp4")
    with replacing_file(path) as partial:
        _encode(frames, partial, frames_per_s)


def _encode(frames: Iterable[NDArray[np.uint8]], path: Path, frames_per_s: float) -> None:
    """Writes the video to `path` directly; an incomplete file stays there if `frames` raises."""
    import imageio_ffmpeg  # optional

    source = iter(frames)
    first = next(source, None)
    if first is None:
        raise ValueError(f"no frames to write to {path}")
    height, width = _even(first).shape[:2]
    encoder = imageio_ffmpeg.write_frames(
        str(path),
        (width, height),
        fps=frames_per_s,
        codec="libx264",
        quality=None,
        pix_fmt_out="yuv420p",
        macro_block_size=1,
        output_params=["-crf", CRF, "-movflags", "+faststart", "-f", "mp4"],
    )
    with contextlib.closing(encoder):
        encoder.send(None)
        for frame in itertools.chain([first], source):
            if frame.shape != first.shape or frame.dtype != np.uint8:
                raise ValueError(f"frames must all be {first.shape} uint8; one is {frame.shape} {frame.dtype}")
            encoder.send(np.ascontiguousarray(_even(frame)))


def _even(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = frame.shape[:2]
    if height % 2 == 0 and width % 2 == 0:
        return frame
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
