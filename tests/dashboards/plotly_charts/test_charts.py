"""The data of the report's charts, against the table of results, Plotly's schema, and the page's colours."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import plotly.graph_objects as go
import pytest
from plotly.colors import sample_colorscale

from actors.evaluation.result_table import ResultRow
from dashboards.analysis.aggregate import GROUPS, ROBOTS, Results, Setup
from dashboards.analysis.methods import method_label
from dashboards.analysis.trainings import CurvePoint, Speed, Training
from dashboards.pages.assets import asset
from dashboards.plotly_charts.chart import Chart
from dashboards.plotly_charts.result_charts import failure_causes, heatmaps, transfers
from dashboards.plotly_charts.run_charts import run_curves, run_speeds, setup_curves, sweep_speeds
from sim_core.plugins import DISSERTATION_METHODS
from tests.dashboards.tables import claimed_table, row

ROWS = claimed_table(without=[row("out", Setup(15, 8), success=0)])
PRESETS = {"thesis": Results(ROWS)}
FAILED = {"lost": 0.1, "captured": 0.05, "collision": 0.0, "timeout": 0.02}
CURVE = [CurvePoint(1000 * i, 0.2 * i, 0.2 * i - 0.1, 0.2 * i + 0.1, FAILED) for i in range(1, 5)]
SPEEDS = [Speed(1000 * i, 5000.0 + i, 100.0 + i) for i in range(1, 6)]
TRAININGS = [
    Training(f"{method} {setup} s{seed}", method, setup, seed, CURVE, SPEEDS)
    for method in DISSERTATION_METHODS
    for setup in (Setup(10, 2), Setup(5, 1))
    for seed in (0, 1)
]
RETURNS = TRAININGS[0]._replace(method="", setup=None, is_share=False, curve=[p._replace(failures=None) for p in CURVE])
CHARTS = [heatmaps(PRESETS), transfers(PRESETS), failure_causes(PRESETS), setup_curves(TRAININGS)]
CHARTS += [sweep_speeds(TRAININGS), run_curves(TRAININGS[0]), run_curves(RETURNS), run_speeds(TRAININGS[0])]


def counted(method: str, played: Setup, trained: Setup | None = None) -> ResultRow:
    home = trained or played
    return next(r for r in ROWS if (r.method, r.trained_robots, r.trained_groups, *r[6:8]) == (method, *home, *played))


def strings(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for item in value.values():
            yield from strings(item)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from strings(item)


def with_plain_colours(value: Any) -> Any:
    if isinstance(value, str):
        return "#123456" if value.startswith("--") else value
    if isinstance(value, dict):
        return {name: with_plain_colours(item) for name, item in value.items()}
    return [with_plain_colours(item) for item in value] if isinstance(value, list | tuple) else value


@pytest.mark.parametrize("chart", CHARTS, ids=lambda chart: chart.title)
def test_plotly_knows_every_property(chart: Chart):
    """`go.Figure` refuses properties that Plotly's schema does not have."""
    figures = [panel.figure for view in chart.views.values() for panel in view.panels]
    assert figures
    for figure in figures:
        go.Figure(with_plain_colours(figure))
    with pytest.raises(ValueError, match="Invalid property"):
        go.Figure({"data": [{**with_plain_colours(figures[0])["data"][0], "colour": "red"}]})


def test_every_colour_is_defined_in_the_light_and_the_dark_scheme():
    used = {text for chart in CHARTS for text in strings(list(chart.views.values())) if text.startswith("--")}
    light, dark = asset("base.css").split("prefers-color-scheme: dark")
    assert used and all(f"{name}:" in light and f"{name}:" in dark for name in used)


@pytest.mark.parametrize("chart", CHARTS, ids=lambda chart: chart.title)
def test_every_choice_has_a_view_with_numbers(chart: Chart):
    for view in chart.views.values():
        assert view.panels and view.table.rows
        assert {len(line) for line in view.table.rows} == {len(view.table.header)}
    start = "|".join(choice.default for choice in chart.choices)
    assert start in chart.views
    assert all(choice.default in dict(choice.options) for choice in chart.choices)


def test_heat_maps_have_the_rates_of_the_table():
    view = heatmaps(PRESETS).views["thesis"]
    for panel, method in zip(view.panels, DISSERTATION_METHODS, strict=True):
        heat = panel.figure["data"][0]
        for robots, line in zip(ROBOTS, heat["z"], strict=True):
            for groups, share in zip(GROUPS, line, strict=True):
                if (method, robots, groups) == ("out", 15, 8):
                    assert share is None
                else:
                    r = counted(method, Setup(robots, groups))
                    assert share == pytest.approx(r.goal / r.episodes)
    words = {text["text"] for text in view.panels[2].figure["layout"]["annotations"]}
    assert "–" in words and '<b>97.0</b><br><span style="font-size:10px">96–98</span>' in words


def contrast(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    lights = []
    for colour in (one, other):
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in colour]
        lights.append(0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2])
    return (max(lights) + 0.05) / (min(lights) + 0.05)


@pytest.mark.parametrize("percent", range(0, 101, 5))
def test_numbers_on_a_heat_map_have_enough_contrast(percent: int):
    rows = [row("sensor", Setup(5, 1), success=percent)]
    panel = heatmaps({"thesis": Results(rows)}).views["thesis"].panels[0]
    colour = panel.figure["layout"]["annotations"][0]["font"]["color"]
    ground = sample_colorscale("Cividis", [percent / 100], colortype="tuple")[0]
    assert contrast({"#000000": (0, 0, 0), "#ffffff": (1, 1, 1)}[colour], ground) >= 4.5


def test_extrapolation_stands_beside_fixed():
    chart = transfers(PRESETS)
    view = chart.views["thesis|sensor|10r×2g"]
    fixed, foreign = view.panels[1].figure["data"]
    assert fixed["x"] == [f"10r×{m}g" for m in GROUPS] and foreign["x"] == ["10r×3g", "10r×4g", "10r×8g"]
    for label, share, up, down in zip(
        foreign["x"], foreign["y"], foreign["error_y"]["array"], foreign["error_y"]["arrayminus"], strict=True
    ):
        groups = int(re.findall(r"\d+", label)[1])
        r = counted("sensor", Setup(10, groups), Setup(10, 2))
        assert share == pytest.approx(r.goal / r.episodes)
        assert 0 < down < 0.03 and 0 < up < 0.03
    assert ("10r×8g", "76.0 % (74.4 … 77.5)", "81.0 % (79.6 … 82.4)") in view.table.rows
    assert "thesis|in|10r×2g" not in chart.views  # no policy of M_IN was tested elsewhere


def test_failures_and_success_add_up_to_one():
    for panel, method in zip(failure_causes(PRESETS).views["thesis"].panels, DISSERTATION_METHODS, strict=True):
        bars = panel.figure["data"]
        assert [bar["name"] for bar in bars] == ["lost", "captured", "collision", "timeout"]
        assert len({bar["marker"]["pattern"]["shape"] for bar in bars}) == 4  # they differ in more than colour
        for place, (robots, groups) in enumerate(zip(*bars[0]["x"], strict=True)):
            setup = Setup(int(robots.split()[0]), int(groups.removesuffix("g")))
            r = counted(method, setup)
            assert sum(bar["y"][place] for bar in bars) == pytest.approx(1 - r.goal / r.episodes)


def test_curves_have_intervals_and_one_line_per_seed():
    figure = setup_curves(TRAININGS).views["5r×1g"].panels[0].figure
    assert [trace["name"] for trace in figure["data"][2::3]] == [
        f"{name} seed {seed}" for name in map(method_label, DISSERTATION_METHODS) for seed in (0, 1)
    ]
    low, high, line = figure["data"][:3]
    assert (low["y"], line["y"], high["y"]) == tuple([getattr(p, f) for p in CURVE] for f in ("low", "value", "high"))
    assert high["fill"] == "tonexty" and line["customdata"][0] == "20.0 % (10.0 … 30.0)"


def test_a_return_is_not_shown_in_percent():
    view = run_curves(RETURNS).views[""]
    assert len(view.panels) == 1 and view.panels[0].title == "Mean return"
    assert "tickformat" not in view.panels[0].figure["layout"]["yaxis"]
    assert view.table.rows[0][2] == "0.20 (0.10 … 0.30)"


def test_without_data_there_is_no_view():
    empty = TRAININGS[0]._replace(curve=[], speeds=[])
    charts = [setup_curves([empty]), sweep_speeds([empty]), run_curves(empty), run_speeds(empty)]
    assert all(chart.views == {} for chart in charts)
