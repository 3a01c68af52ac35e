"""Charts of a table of results: success of every cell, Fixed beside Extrapolation, and causes of failure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from plotly.colors import sample_colorscale

from actors.evaluation.result_table import GROUPS, ROBOTS
from actors.evaluation.statistics import as_percent
from dashboards.analysis.aggregate import SETUPS, Measurement, Results, Setup, measured, success
from dashboards.analysis.failure_styles import FAILURE_STYLES
from dashboards.analysis.methods import in_order, method_label
from dashboards.plotly_charts.chart import (
    Chart,
    Choice,
    Figure,
    Panel,
    Table,
    View,
    error_bars,
    layout,
    patterned,
    percent_text,
    share_axis,
)
from sim_core.outcomes import OUTCOME_NAMES, Outcome

OUTCOMES = {name: Outcome(number) for number, name in enumerate(OUTCOME_NAMES)}
"""Outcomes by name."""
FAVOURITE = Setup(10, 2)
"""The setup that charts show first, if it has data."""
INTERVALS = "Brackets are 95 % intervals (Wilson's, widened by the variation between seeds)."
HEAT = "Cividis"
"""Colour scale of shares; it reads the same with a colour-vision deficiency."""


def preset_choice(presets: Mapping[str, Results]) -> Choice:
    """The choice of a preset; initially the first."""
    return Choice("preset", "Preset", [(name, name) for name in presets], next(iter(presets)))


def setup_choice(name: str, label: str, setups: list[Setup]) -> Choice:
    """The choice of a setup; initially `FAVOURITE` if it is among them."""
    first = FAVOURITE if FAVOURITE in setups else setups[0]
    return Choice(name, label, [(str(setup), str(setup)) for setup in setups], str(first))


def method_choice(methods: list[str]) -> Choice:
    """The choice of a method; initially the first."""
    return Choice("method", "Method", [(method, method_label(method)) for method in methods], methods[0])


def heatmaps(presets: Mapping[str, Results]) -> Chart:
    """Heat maps of Fixed success over robots and groups, one per method."""
    views = {}
    for name, results in presets.items():
        found = {method: _fixed_rates(results, method) for method in results.methods()}
        panels = [Panel(method_label(method), _heatmap(rates)) for method, rates in found.items()]
        lines = [
            (method_label(method), f"{robots}r", *(percent_text(rates.get(Setup(robots, m))) for m in GROUPS))
            for method, rates in found.items()
            for robots in ROBOTS
        ]
        header = ("method", "robots per group", *(f"{groups} group{'s' * (groups > 1)}" for groups in GROUPS))
        views[name] = View(panels, Table(header, lines))
    note = "Share of episodes that end in the goal, in percent; trained and tested in the same setup (Fixed)."
    hint = " A click on a cell shows that setup in the charts and in the player below."
    return Chart("success", "Success by robots and groups", note + hint, [preset_choice(presets)], views)


def _fixed_rates(results: Results, method: str) -> dict[Setup, Measurement]:
    rates = {setup: measured(results.fixed(method, setup), success) for setup in SETUPS}
    return {setup: rate for setup, rate in rates.items() if rate is not None}


def _heatmap(rates: dict[Setup, Measurement]) -> Figure:
    lines = [[rates.get(Setup(robots, groups)) for groups in GROUPS] for robots in ROBOTS]
    heat = {
        "type": "heatmap",
        "x": [f"{groups}g" for groups in GROUPS],
        "y": [f"{robots}r" for robots in ROBOTS],
        "z": [[None if rate is None else rate.estimate.value for rate in line] for line in lines],
        "customdata": [[percent_text(rate) for rate in line] for line in lines],
        "hovertemplate": "%{y}×%{x}: %{customdata}<extra></extra>",
        "hoverongaps": False,
        "colorscale": HEAT,
        "zmin": 0.0,
        "zmax": 1.0,
        "showscale": False,
        "xgap": 2,
        "ygap": 2,
    }
    axis = {"showgrid": False, "fixedrange": True, "ticks": ""}
    texts = [_cell_text(setup, rates.get(setup)) for setup in SETUPS]
    shape = layout(xaxis=axis, yaxis={**axis, "autorange": "reversed"}, annotations=texts)
    return {"data": [heat], "layout": {**shape, "margin": {"l": 34, "r": 4, "t": 4, "b": 28}, "height": 300}}


def _cell_text(setup: Setup, rate: Measurement | None) -> dict[str, object]:
    """Annotation of a cell: its rate and interval, in black or white, whichever has the higher contrast there."""
    text = {"x": f"{setup.groups}g", "y": f"{setup.robots}r", "showarrow": False}
    if rate is None:
        return {**text, "text": "–", "font": {"color": "--muted"}}
    value, low, high = (100 * number for number in rate.estimate)
    colour = "#000000" if _luminance(rate.estimate.value) > BLACK_FROM else "#ffffff"
    words = f'<b>{value:.1f}</b><br><span style="font-size:10px">{low:.0f}–{high:.0f}</span>'
    return {**text, "text": words, "font": {"color": colour}}


BLACK_FROM = 0.179
"""Relative luminance from which black has a higher contrast than white (WCAG 2: (L + 0.05)^2 = 1.05 * 0.05)."""


def _luminance(share: float) -> float:
    """Relative luminance (WCAG 2) of the scale's colour for a share."""
    ((red, green, blue),) = sample_colorscale(HEAT, [share], colortype="tuple")
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in (red, green, blue)]
    return float(0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2])


def transfers(presets: Mapping[str, Results]) -> Chart:
    """Policies trained in one setup and tested in others, beside those trained in the test's setup."""
    known = in_order(method for results in presets.values() for method in results.methods())
    methods = [m for m in known if any(results.fixed_present(m) for results in presets.values())]
    setups = [s for s in SETUPS if any(results.fixed(m, s) for m in methods for results in presets.values())]
    views = {}
    for name, results in presets.items():
        for method in methods:
            for trained in setups:
                view = _transfer_view(results, method, trained)
                if view is not None:
                    views[f"{name}|{method}|{trained}"] = view
    choices = [preset_choice(presets), method_choice(methods), setup_choice("trained", "Trained in", setups)]
    note = (
        "Extrapolation: the policy trained in the chosen setup, tested in the setup on the axis. Fixed: a policy "
        f"trained in the setup on the axis. {INTERVALS} The states of M_IN and M_OUT have one row per group, so that "
        "their number of groups cannot change."
    )
    return Chart("transfer", "Fixed against Extrapolation", note, choices, views)


def _transfer_view(results: Results, method: str, trained: Setup) -> View | None:
    series = {
        "with other robots per group": [Setup(robots, trained.groups) for robots in ROBOTS],
        "with other groups": [Setup(trained.robots, groups) for groups in GROUPS],
    }
    panels, lines = [], []
    for title, played in series.items():
        fixed = {setup: measured(results.fixed(method, setup), success) for setup in played}
        foreign = {
            setup: measured(results.transferred(method, trained, setup), success)
            for setup in played
            if setup != trained
        }
        if not any(foreign.values()):
            continue
        panels.append(Panel(f"Trained in {trained}, {title}", _transfer_figure(fixed, foreign)))
        lines += [(str(setup), percent_text(fixed[setup]), percent_text(foreign.get(setup))) for setup in played]
    header = ("tested in", "Fixed", f"Extrapolation from {trained}")
    return View(panels, Table(header, lines)) if panels else None


def _transfer_figure(fixed: Mapping[Setup, Measurement | None], foreign: Mapping[Setup, Measurement | None]) -> Figure:
    bars = [_bars("Fixed", fixed, "--fixed", ""), _bars("Extrapolation", foreign, "--transfer", "/")]
    order = {"type": "category", "categoryarray": [str(setup) for setup in fixed], "categoryorder": "array"}
    axis = {**order, "range": [-0.5, len(fixed) - 0.5], "fixedrange": True, "showgrid": False}
    return {"data": bars, "layout": layout(barmode="group", bargap=0.25, xaxis=axis, yaxis=share_axis())}


def _bars(name: str, rates: Mapping[Setup, Measurement | None], colour: str, pattern: str) -> dict[str, object]:
    found = {setup: rate for setup, rate in rates.items() if rate is not None}
    return {
        "type": "bar",
        "name": name,
        "x": [str(setup) for setup in found],
        "y": [rate.estimate.value for rate in found.values()],
        "error_y": error_bars(list(found.values())),
        "customdata": [as_percent(rate.estimate) for rate in found.values()],
        "hovertemplate": "%{x}: %{customdata}<extra>" + name + "</extra>",
        "marker": patterned(colour, pattern),
    }


def failure_causes(presets: Mapping[str, Results]) -> Chart:
    """Causes of failure of Fixed episodes, one bar per setup."""
    views = {}
    for name, results in presets.items():
        found = {
            method: _failure_shares(results, method) for method in results.methods() if results.fixed_present(method)
        }
        failed = [sum(rate.estimate.value for rate in row.values()) for rows in found.values() for row in rows.values()]
        axis = share_axis(min(max([0.05, *failed]), 1.0))
        panels = [Panel(method_label(method), _failure_figure(rows, axis), wide=True) for method, rows in found.items()]
        lines = [
            (method_label(method), str(setup), *(percent_text(rate) for rate in row.values()))
            for method, rows in found.items()
            for setup, row in rows.items()
        ]
        if panels:
            views[name] = View(panels, Table(("method", "setup", *FAILURE_STYLES), lines))
    note = (
        "Share of all episodes that end in each failure, trained and tested in the same setup; the rest succeed. Bars "
        "are grouped by robots per group. Setups without data have no bar."
    )
    return Chart("failures", "Why episodes fail", note, [preset_choice(presets)], views)


def _failure_shares(results: Results, method: str) -> dict[Setup, dict[str, Measurement]]:
    cells = {setup: results.fixed(method, setup) for setup in SETUPS}
    return {
        setup: {cause: cell.share(OUTCOMES[cause]) for cause in FAILURE_STYLES}
        for setup, cell in cells.items()
        if cell is not None
    }


def _failure_figure(shares: Mapping[Setup, Mapping[str, Measurement]], y_axis: dict[str, Any]) -> Figure:
    bars = []
    places = [[f"{setup.robots} robots" for setup in shares], [f"{setup.groups}g" for setup in shares]]
    for cause, style in FAILURE_STYLES.items():
        rates = [row[cause] for row in shares.values()]
        texts = [[str(setup), as_percent(rate.estimate)] for setup, rate in zip(shares, rates, strict=True)]
        bars.append(
            {
                "type": "bar",
                "name": cause,
                "x": places,
                "y": [rate.estimate.value for rate in rates],
                "customdata": texts,
                "hovertemplate": "%{customdata[0]}: %{customdata[1]}<extra>" + cause + "</extra>",
                "marker": patterned(f"--{cause}", style.pattern),
            }
        )
    axis = {"fixedrange": True, "showgrid": False, "dividercolor": "--line", "dividerwidth": 1}
    return {"data": bars, "layout": layout(barmode="stack", bargap=0.2, xaxis=axis, yaxis=y_axis, height=260)}
