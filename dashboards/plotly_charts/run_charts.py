"""Charts of trainings: learning curves with their intervals, and speeds."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

from actors.evaluation.statistics import Estimate, as_percent
from dashboards.analysis.aggregate import Setup
from dashboards.analysis.failure_styles import FAILURE_STYLES
from dashboards.analysis.methods import in_order, method_label, method_style
from dashboards.analysis.trainings import CurvePoint, Training
from dashboards.plotly_charts.chart import (
    Chart,
    Figure,
    Panel,
    Table,
    View,
    layout,
    share_axis,
)
from dashboards.plotly_charts.result_charts import setup_choice

TICKS = [figure * 10**power for power in range(8) for figure in (1, 2, 5)]
"""Ticks of logarithmic axes."""
BANDS = "The band is the 95 % interval of each evaluation"


def setup_curves(trainings: Sequence[Training]) -> Chart:
    """Learning curves of many trainings: one view per setup, one line per method and seed."""
    by_setup: dict[Setup, list[Training]] = {}
    for training in trainings:
        if training.setup is not None and training.curve:
            by_setup.setdefault(training.setup, []).append(training)
    order = in_order(training.method for training in trainings)
    views = {}
    for setup in sorted(by_setup):
        found = sorted(by_setup[setup], key=lambda training: (order.index(training.method), training.seed))
        panels = [Panel(f"Success in {setup}", _curves_figure(found), wide=True)]
        views[str(setup)] = View(panels, _curves_table(found))
    choices = [setup_choice("setup", "Setup", sorted(by_setup))] if by_setup else []
    note = f"Greedy episodes on fixed seeds during training. {BANDS}; one line per training seed."
    return Chart("curves", "Learning curves", note, choices, views)


def run_curves(training: Training) -> Chart:
    """The learning curve of one training, and its shares of failures."""
    value = "success rate" if training.is_share else "mean return"
    panels = [Panel(value.capitalize(), _curves_figure([training]))]
    failed = [point for point in training.curve if point.failures is not None]
    if failed:
        panels.append(Panel("Failed episodes", _failures_figure(failed)))
    views = {"": View(panels, _curves_table([training]))} if training.curve else {}
    return Chart("curves", "Learning curve", f"Greedy episodes on fixed seeds during training. {BANDS}.", [], views)


def _curves_figure(trainings: Sequence[Training]) -> Figure:
    traces = [trace for training in trainings for trace in _curve_traces(training)]
    is_share = all(training.is_share for training in trainings)
    y_axis = share_axis() if is_share else {"fixedrange": True, "zeroline": False}
    return {"data": traces, "layout": layout(height=340, xaxis=_steps_axis(), yaxis=y_axis, hovermode="x unified")}


def _steps_axis() -> dict[str, object]:
    return {"title": {"text": "env steps"}, "rangemode": "tozero", "fixedrange": True, "showgrid": False}


def _curve_traces(training: Training) -> list[dict[str, object]]:
    style = method_style(training.method or "sensor")
    colour = style.css_colour
    name = f"{method_label(training.method)} seed {training.seed}" if training.method else "mean return"
    steps = [point.env_steps for point in training.curve]
    edge = {"type": "scatter", "mode": "lines", "x": steps, "line": {"width": 0}, "hoverinfo": "skip"}
    low = {**edge, "y": [point.low for point in training.curve], "showlegend": False, "legendgroup": training.name}
    high = {**low, "y": [point.high for point in training.curve], "fill": "tonexty", "fillcolor": f"{colour}-band"}
    line: dict[str, object] = {
        "type": "scatter",
        "mode": "lines+markers",
        "name": name,
        "legendgroup": training.name,
        "x": steps,
        "y": [point.value for point in training.curve],
        "customdata": [_value_text(point, training.is_share) for point in training.curve],
        "hovertemplate": "%{customdata}",
        "line": {"color": colour, "width": 2, "dash": style.dash},
        "marker": {"color": colour, "size": 5, "symbol": style.symbol},
    }
    return [low, high, line]


def _value_text(point: CurvePoint, is_share: bool) -> str:
    if is_share:
        return as_percent(Estimate(point.value, point.low, point.high))
    return f"{point.value:.2f} ({point.low:.2f} … {point.high:.2f})"


def _failures_figure(points: Sequence[CurvePoint]) -> Figure:
    traces = []
    for cause, style in FAILURE_STYLES.items():
        shares = [point.failures[cause] for point in points if point.failures is not None]
        traces.append(
            {
                "type": "scatter",
                "mode": "lines+markers",
                "name": cause,
                "x": [point.env_steps for point in points],
                "y": shares,
                "hovertemplate": "%{y:.1%}",
                "line": {"color": f"--{cause}", "width": 1.8, "dash": style.dash},
                "marker": {"color": f"--{cause}", "size": 5, "symbol": style.marker},
            }
        )
    top = max((max(point.failures.values(), default=0.0) for point in points if point.failures), default=0.0)
    axis = share_axis(max(top, 0.05))
    return {"data": traces, "layout": layout(height=340, xaxis=_steps_axis(), yaxis=axis, hovermode="x unified")}


def _curves_table(trainings: Sequence[Training]) -> Table:
    lines = [
        (training.name, f"{point.env_steps:,}", _value_text(point, training.is_share))
        for training in trainings
        for point in training.curve
    ]
    return Table(("training", "env steps", "success rate" if trainings[0].is_share else "mean return"), lines)


def sweep_speeds(trainings: Sequence[Training]) -> Chart:
    """Env steps per second of many trainings against the number of robots in a world."""
    found = [training for training in trainings if training.setup is not None and training.speeds]
    views = {}
    if found:
        panels = [Panel("Env steps per second, median of a training", _speeds_by_robots(found), wide=True)]
        lines = [
            (training.name, *(f"{value:,.0f}" for value in (_middle(training), *_range(training))))
            for training in found
        ]
        views[""] = View(panels, Table(("training", "median env steps/s", "lowest", "highest"), lines))
    note = (
        "Each point is one training, including its updates; several may have shared a machine. From the journals. "
        "Both axes are logarithmic."
    )
    return Chart("throughput", "Throughput", note, [], views)


def _middle(training: Training) -> float:
    return median(speed.env_steps_per_s for speed in training.speeds)


def _range(training: Training) -> tuple[float, float]:
    values = [speed.env_steps_per_s for speed in training.speeds]
    return min(values), max(values)


def _speeds_by_robots(trainings: Sequence[Training]) -> Figure:
    traces = []
    for method in in_order(training.method for training in trainings if training.method):
        style = method_style(method)
        own = [training for training in trainings if training.method == method]
        if own:
            traces.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "name": method_label(method),
                    "x": [t.setup.robots * t.setup.groups for t in own if t.setup is not None],
                    "y": [_middle(training) for training in own],
                    "text": [training.name for training in own],
                    "hovertemplate": "%{text}: %{y:,.0f} env steps/s<extra></extra>",
                    "marker": {"color": style.css_colour, "symbol": style.symbol, "size": 9},
                }
            )
    axes = {"type": "log", "fixedrange": True, "tickmode": "array", "tickvals": TICKS}
    x_axis = {**axes, "title": {"text": "robots in a world"}, "showgrid": False}
    y_axis = {**axes, "title": {"text": "env steps/s"}, "tickformat": "~s"}
    return {"data": traces, "layout": layout(height=340, xaxis=x_axis, yaxis=y_axis)}


def run_speeds(training: Training) -> Chart:
    """Env steps and updates per second over the course of one training."""
    views = {}
    if training.speeds:
        names = ("env_steps_per_s", "updates_per_s")
        titles = ("Env steps per second", "Updates per second")
        panels = [Panel(title, _speed_figure(training, name)) for title, name in zip(titles, names, strict=True)]
        lines = [(f"{s.env_steps:,}", f"{s.env_steps_per_s:,.0f}", f"{s.updates_per_s:,.0f}") for s in training.speeds]
        views[""] = View(panels, Table(("env steps", "env steps/s", "updates/s"), lines))
    return Chart(
        "speed", "Throughput", "Each point is the mean since the point before, including evaluations.", [], views
    )


def _speed_figure(training: Training, name: str) -> Figure:
    trace = {
        "type": "scatter",
        "mode": "lines",
        "x": [speed.env_steps for speed in training.speeds],
        "y": [getattr(speed, name) for speed in training.speeds],
        "hovertemplate": "%{x:,} env steps: %{y:,.0f}/s<extra></extra>",
        "line": {"color": "--sensor", "width": 1.8},
    }
    y_axis = {"rangemode": "tozero", "fixedrange": True, "tickformat": "~s"}
    return {"data": [trace], "layout": layout(height=260, xaxis=_steps_axis(), yaxis=y_axis, showlegend=False)}
