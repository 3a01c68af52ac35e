"""The learning curve of one training as PNG."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter, PercentFormatter

from dashboards.analysis.failure_styles import FAILURE_STYLES
from dashboards.analysis.trainings import CurvePoint
from dashboards.figures.style import LINE_STYLES, MARKERS, TEXT, escaped, new_figure, style_axes

VALUE = "#0072B2"
DPI = 150


def learning_curve_png(
    points: list[CurvePoint], path: Path, title: str, value_label: str = "success rate", is_share: bool = True
) -> None:
    """Draws the value against env steps with its 95 % interval, and below it the shares of failures if there are any.

    Args:
      points: evaluations in the order of their env steps.
      path: the PNG; replaced if it exists.
      title: plain text.
      value_label: name of the value, with its unit if it has one.
      is_share: whether the value lies in [0, 1] and is shown in percent.

    Raises:
      ValueError: there are no points.
    """
    if not points:
        raise ValueError(f"no evaluations to draw in {path}")
    failed = [point for point in points if point.failures is not None]
    figure = new_figure(7.0, 5.6 if failed else 3.6, title, DPI)
    panels = figure.subplots(2 if failed else 1, 1, sharex=True, squeeze=False, height_ratios=[3, 2] if failed else [1])
    top, bottom = panels[0, 0], panels[-1, 0]
    _draw_value(top, points, value_label, is_share)
    if failed:
        _draw_failures(bottom, failed)
    bottom.set_xlabel("env steps", color=TEXT)
    bottom.xaxis.set_major_formatter(EngFormatter(sep=""))
    figure.savefig(path, format="png")


def _draw_value(axes: Axes, points: list[CurvePoint], label: str, is_share: bool) -> None:
    steps = [point.env_steps for point in points]
    axes.fill_between(
        steps,
        [point.low for point in points],
        [point.high for point in points],
        color=VALUE,
        alpha=0.2,
        lw=0,
        label="95 % interval",
    )
    axes.plot(steps, [point.value for point in points], color=VALUE, lw=2, marker="o", ms=3.5, label=label)
    if len(points) == 1:
        (only,) = points
        axes.errorbar(
            steps, [only.value], yerr=[[only.value - only.low], [only.high - only.value]], color=VALUE, capsize=4
        )
    _style(axes, label, is_share)
    _legend(axes)


def _draw_failures(axes: Axes, points: list[CurvePoint]) -> None:
    for name, style in FAILURE_STYLES.items():
        found = [
            (point.env_steps, point.failures[name]) for point in points if point.failures and name in point.failures
        ]
        if found:
            steps, shares = zip(*found, strict=True)
            line, marker = LINE_STYLES[style.dash], MARKERS[style.marker]
            axes.plot(steps, shares, color=style.colour, ls=line, lw=1.6, marker=marker, ms=3.5, label=name)
    _style(axes, "failed episodes", is_share=True)
    largest = max((share for point in points if point.failures for share in point.failures.values()), default=0.0)
    axes.set_ylim(0.0, max(1.1 * largest, 0.05))
    if axes.get_legend_handles_labels()[0]:
        _legend(axes)


def _style(axes: Axes, label: str, is_share: bool) -> None:
    axes.set_ylabel(escaped(label), color=TEXT)
    if is_share:
        axes.set_ylim(0.0, 1.02)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=None))
    style_axes(axes)


def _legend(axes: Axes) -> None:
    """A legend in one row above the axes, where it hides no point."""
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        borderaxespad=0.1,
        borderpad=0.2,
        ncols=4,
        handlelength=3.2,
        frameon=False,
        fontsize=9,
        labelcolor=TEXT,
    )
