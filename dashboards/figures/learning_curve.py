"""Learning curves as PNG, drawn without a display and without pyplot's global state."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

TEXT, MUTED, GRID, VALUE = "#1C2024", "#5A6470", "#E3E6EA", "#0072B2"
FAILURE_STYLES = {
    "lost": ("#D55E00", "-", "o"),
    "captured": ("#882255", "--", "s"),
    "collision": ("#009E73", "-.", "^"),
    "timeout": ("#5A6470", ":", "D"),
}
"""Colour, line and marker of each way to fail, so that none is told by its colour alone."""


class CurvePoint(NamedTuple):
    """One evaluation: the value after `env_steps` with its 95 % interval [low, high].

    `failures` maps an outcome's name to its share of the episodes in [0, 1]; None where it was not measured.
    """

    env_steps: int
    value: float
    low: float
    high: float
    failures: dict[str, float] | None


def learning_curve_png(
    rows: list[CurvePoint], path: Path, title: str, value_label: str = "success rate", is_share: bool = True
) -> None:
    """Draws value against env steps with its 95 % interval, and under it the failure shares where there are any.

    Args:
      rows: evaluations in the order of their env steps.
      path: the PNG; replaced if it exists.
      title: plain text.
      value_label: what the value is, with its unit if it has one.
      is_share: whether the value lies in [0, 1] and is shown in percent.

    Raises:
      ValueError: there are no rows.
    """
    if not rows:
        raise ValueError(f"no evaluations to draw in {path}")
    failed = [row for row in rows if row.failures is not None]
    figure = Figure(figsize=(7.0, 5.6 if failed else 3.6), dpi=150, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2 if failed else 1, 1, sharex=True, squeeze=False, height_ratios=[3, 2] if failed else [1])
    top, bottom = panels[0, 0], panels[-1, 0]
    figure.suptitle(title.replace("$", r"\$"), x=0.01, ha="left", fontsize=12, fontweight="bold", color=TEXT)
    _draw_value(top, rows, value_label, is_share)
    if failed:
        _draw_failures(bottom, failed)
    bottom.set_xlabel("env steps", color=TEXT)
    bottom.xaxis.set_major_formatter(EngFormatter(sep=""))
    figure.savefig(path, format="png")


def _draw_value(axes: Axes, rows: list[CurvePoint], label: str, is_share: bool) -> None:
    steps = [row.env_steps for row in rows]
    axes.fill_between(
        steps,
        [row.low for row in rows],
        [row.high for row in rows],
        color=VALUE,
        alpha=0.2,
        lw=0,
        label="95 % interval",
    )
    axes.plot(steps, [row.value for row in rows], color=VALUE, lw=2, marker="o", ms=3.5, label=label)
    if len(rows) == 1:
        spread = [[rows[0].value - rows[0].low], [rows[0].high - rows[0].value]]
        axes.errorbar(steps, [rows[0].value], yerr=spread, color=VALUE, capsize=4)
    _dress(axes, label, is_share)
    _legend(axes)


def _draw_failures(axes: Axes, rows: list[CurvePoint]) -> None:
    for name, (colour, line, marker) in FAILURE_STYLES.items():
        found = [(row.env_steps, row.failures[name]) for row in rows if row.failures and name in row.failures]
        if found:
            steps, shares = zip(*found, strict=True)
            axes.plot(steps, shares, color=colour, ls=line, lw=1.6, marker=marker, ms=3.5, label=name)
    _dress(axes, "failed episodes", is_share=True)
    largest = max((share for row in rows if row.failures for share in row.failures.values()), default=0.0)
    axes.set_ylim(0.0, max(1.1 * largest, 0.05))
    if axes.get_legend_handles_labels()[0]:
        _legend(axes)


def _dress(axes: Axes, label: str, is_share: bool) -> None:
    axes.set_ylabel(label.replace("$", r"\$"), color=TEXT)
    if is_share:
        axes.set_ylim(0.0, 1.02)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=None))
    axes.grid(axis="y", color=GRID)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GRID)
    axes.tick_params(colors=MUTED, length=0)


def _legend(axes: Axes) -> None:
    """A row above the axes, where it hides no point."""
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
