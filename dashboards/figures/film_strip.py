"""A strip of frames from one episode side by side, as in the dissertation's Figure 3.2."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from actors.evaluation.trajectory import Episode
from dashboards.figures.style import DPI, MUTED, TEXT
from sim_core.config import WorldConfig
from sim_core.outcomes import OUTCOME_NAMES, Outcome
from sim_core.render import draw_world

FRAME_PX = 300
GAP_PX = 10
HEAD_PX, FOOT_PX = 34, 34
SUCCESS, FAILURE = "#0A6B45", "#B3261E"


def frame_steps(num_states: int, frames: int) -> NDArray[np.int64]:
    """At most `frames` steps, evenly spaced over `num_states` recorded states, first and last included."""
    return np.unique(np.rint(np.linspace(0, num_states - 1, frames)).astype(np.int64))


def episode_strip_png(episode: Episode, config: WorldConfig, path: Path, frames: int = 6) -> None:
    """Writes `episode_strip` as PNG; an existing file is replaced.

    Raises:
      ValueError: fewer than 2 frames.
    """
    figure = episode_strip(episode, config, frames)
    figure.savefig(path, format="png", dpi=DPI, pil_kwargs={"optimize": True})


def episode_strip(episode: Episode, config: WorldConfig, frames: int = 6, remark: str = "") -> Figure:
    """Draws the strip, with the step above each frame and the outcome above the last.

    Args:
      episode: T + 1 recorded states.
      config: the setup it was recorded in.
      frames: number of frames, at least 2; fewer are drawn if there are fewer states.
      remark: a sentence to add to the caption below.

    Raises:
      ValueError: fewer than 2 frames.
    """
    if frames < 2:
        raise ValueError(f"a strip shows the first and the last state: frames must be at least 2, not {frames}")
    steps = frame_steps(len(episode.position), frames)
    width_px = len(steps) * (FRAME_PX + GAP_PX) + GAP_PX
    height_px = HEAD_PX + FRAME_PX + FOOT_PX
    figure = Figure(figsize=(width_px / DPI, height_px / DPI), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    for i, step in enumerate(steps):
        left_px = GAP_PX + i * (FRAME_PX + GAP_PX)
        image = draw_world(episode.position[step], episode.goal, episode.learner, config, FRAME_PX)
        figure.figimage(_framed(image), xo=left_px, yo=FOOT_PX)
        text, colour = _frame_title(int(step), episode, last=i == len(steps) - 1)
        _write(figure, left_px, height_px - HEAD_PX / 2, text, colour, weight="bold")
    _write(figure, GAP_PX, FOOT_PX / 2, f"{_caption(episode, config)} {remark}".rstrip(), MUTED, weight="normal")
    return figure


def _frame_title(step: int, episode: Episode, last: bool) -> tuple[str, str]:
    if not last or episode.outcome == Outcome.RUNNING:
        return f"step {step}", TEXT
    colour = SUCCESS if episode.outcome == Outcome.GOAL else FAILURE
    return f"step {step}: {OUTCOME_NAMES[episode.outcome]}", colour


def _caption(episode: Episode, config: WorldConfig) -> str:
    return (
        f"{config.setup}, seed {episode.seed}. Black: the learning robot on its sensing disc "
        f"(R2 = {config.outer_radius_m:g} m). Squares: goals, its own edged in black."
    )


def _write(figure: Figure, x_px: float, y_px: float, text: str, colour: str, weight: str) -> None:
    width_px, height_px = figure.get_size_inches() * DPI
    figure.text(x_px / width_px, y_px / height_px, text, color=colour, fontweight=weight, fontsize=10.5, va="center")


def _framed(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """`image` `[height, width, 3]` with 16 levels per channel, for half the bytes, and a grey edge of one pixel."""
    framed = (np.rint(image / 17.0) * 17.0).astype(np.uint8)
    for line in (framed[0], framed[-1], framed[:, 0], framed[:, -1]):
        line[...] = 0xD5
    return framed
