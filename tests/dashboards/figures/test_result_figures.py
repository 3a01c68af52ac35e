"""The result figures, read back from their drawings and files."""

from __future__ import annotations

from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from actors.evaluation.statistics import rate
from dashboards.analysis.aggregate import GROUPS, ROBOTS, SETUPS, Results, Setup
from dashboards.analysis.methods import STYLES, method_style
from dashboards.figures.result_figures import (
    FIXED_STYLE,
    PICTURES,
    TRANSFER_STYLE,
    Picture,
    figure_3_4,
    figure_3_5,
    figure_3_6,
    figure_3_7,
    figure_4_4,
    figure_4_5,
    heatmap,
)
from dashboards.figures.style import new_figure, save_png
from sim_core.plugins import DISSERTATION_METHODS
from tests.dashboards.tables import IN_SUCCESS, OUT_SUCCESS, SENSOR_SUCCESS, claimed_table, fixed


@pytest.fixture(scope="module")
def results() -> Results:
    return Results(claimed_table())


def bars(axes: Axes, style: tuple[str, str, str]) -> dict[int, float]:
    """Heights in percent of the bars of a style, by their label's index."""
    colour, hatch, _ = style
    found = [bar for bar in axes.patches if isinstance(bar, Rectangle) and (bar.get_hatch() or "") == hatch]
    found = [bar for bar in found if np.allclose(bar.get_facecolor()[:3], matplotlib.colors.to_rgb(colour))]
    return {round(bar.get_x() + bar.get_width() / 2): round(100 * bar.get_height(), 6) for bar in found}


def labels(axes: Axes) -> list[str]:
    return [label.get_text() for label in axes.get_xticklabels()]


def diamonds(axes: Axes) -> list[tuple[int, float]]:
    marks = [line for line in axes.lines if line.get_marker() == "D"]
    return [(round(float(mark.get_xdata()[0])), float(mark.get_ydata()[0])) for mark in marks]


def test_single_group_figure_has_fixed_beside_extrapolation(results: Results):
    a, b, c, d = figure_3_4(results).axes
    assert labels(a) == [f"{n}r×1g" for n in ROBOTS] and labels(b) == [f"{n}r×1g" for n in ROBOTS[1:]]
    assert labels(c) == [f"5r×{m}g" for m in GROUPS] and labels(d) == [f"10r×{m}g" for m in GROUPS]
    assert bars(a, FIXED_STYLE) == {place: SENSOR_SUCCESS[n][0] for place, n in enumerate(ROBOTS)}
    assert bars(a, TRANSFER_STYLE) == {0: 94, 1: 97, 2: 80, 3: 80, 4: 80}
    assert bars(c, FIXED_STYLE) == dict(enumerate(SENSOR_SUCCESS[5]))
    assert bars(c, TRANSFER_STYLE) == {0: 94, 1: 88}, "missing cells have no bar"
    assert [axes.get_title(loc="left")[:3] for axes in (a, b, c, d)] == ["(a)", "(b)", "(c)", "(d)"]


def test_printed_numbers_are_marked_at_their_setups(results: Results):
    a, b, c, d = figure_3_4(results).axes
    assert diamonds(a) == [(0, 1.0)] and diamonds(c) == [(0, 1.0), (4, 0.5)] and diamonds(d) == []
    assert diamonds(b) == [(place, 0.85) for place in range(4)]
    assert diamonds(figure_3_5(results).axes[2]) == [(0, 0.9), (3, 0.6)]
    assert diamonds(figure_3_6(results).axes[0]) == [(0, 0.9), (3, 0.55)]
    assert diamonds(figure_4_5(results).axes[1]) == [(1, 0.04), (3, 0.08)]


def test_several_group_figures_start_at_the_setup_of_the_training(results: Results):
    more_robots, more_groups = figure_3_5(results).axes, figure_3_6(results).axes
    assert [labels(axes)[0] for axes in more_robots] == ["5r×2g", "5r×3g", "10r×2g", "10r×3g"]
    assert [labels(axes)[0] for axes in more_groups] == ["5r×2g", "5r×3g", "10r×2g", "10r×3g"]
    assert bars(more_robots[0], TRANSFER_STYLE) == {0: 84, 1: 96, 2: 90, 3: 84, 4: 72}
    assert bars(more_groups[2], FIXED_STYLE) == dict(enumerate(SENSOR_SUCCESS[10][1:]))
    assert bars(more_groups[2], TRANSFER_STYLE) == {0: 92, 1: 92, 2: 89, 3: 81}


def test_the_methods_figure_has_one_chart_per_robot_count(results: Results):
    *charts, key = figure_4_4(results).axes
    assert len(charts) == 5 and key.get_legend() is not None
    for axes, robots in zip(charts, ROBOTS, strict=True):
        assert bars(axes, method_style("sensor")[:3]) == dict(enumerate(SENSOR_SUCCESS[robots]))
        assert bars(axes, method_style("out")[:3]) == dict(enumerate(OUT_SUCCESS[robots]))
        assert bars(axes, method_style("in")[:3]) == dict.fromkeys(range(5), IN_SUCCESS)


def test_series_differ_in_more_than_colour():
    assert len({style.hatch for style in STYLES}) == len(STYLES)
    assert FIXED_STYLE[1] != TRANSFER_STYLE[1]


def test_error_bars_are_wilson_intervals(results: Results):
    axes = figure_4_4(results).axes[0]
    spans = [tuple(segment[:, 1]) for group in axes.collections for segment in group.get_segments()]
    assert len(spans) == 15
    estimate = rate(round(0.84 * 3000), 3000)
    assert any(span == pytest.approx((estimate.low, estimate.high)) for span in spans)


def test_lost_and_captured_are_means_of_the_other_axis(results: Results):
    by_robots, by_groups = figure_3_7(results).axes
    lost, captured = (line for line in by_robots.lines if len(line.get_xdata()) == 5)
    assert lost.get_ydata() == pytest.approx([0.136, 0.054, 0.056, 0.082, 0.122])
    assert captured.get_ydata() == pytest.approx([0, 0.018, 0.036, 0.042, 0.054])
    lost, captured = (line for line in by_groups.lines if len(line.get_xdata()) == 5)
    assert captured.get_ydata()[-1] == pytest.approx((0 + 8 + 13 + 13 + 18) / 500)
    assert lost.get_linestyle() != captured.get_linestyle() and lost.get_marker() != captured.get_marker()


def test_two_methods_captured_is_left_and_lost_is_right(results: Results):
    left, right = figure_4_5(results).axes
    sensor, out = (line for line in left.lines if len(line.get_xdata()) == 5)
    assert sensor.get_ydata()[1] == pytest.approx(0.018) and out.get_ydata()[4] == pytest.approx(0.042)
    sensor, out = (line for line in right.lines if len(line.get_xdata()) == 5)
    assert sensor.get_ydata()[0] == pytest.approx(0.136) and out.get_ydata()[0] == pytest.approx(0.064)


@pytest.mark.parametrize("lost", [0.4, 6.0, 11.0, 19.0, 43.0, 100.0])
def test_ticks_of_failures_are_at_whole_percents(lost: float):
    rows = [fixed("sensor", setup, success=0, captured=0, lost=lost) for setup in SETUPS]
    axes = figure_3_7(Results(rows)).axes[0]
    axes.figure.canvas.draw()
    every = zip(axes.get_yticklabels(), axes.get_yticks(), strict=True)
    ticks = [(label.get_text(), 100 * at) for label, at in every if 0 <= at <= axes.get_ylim()[1]]
    assert all(text == f"{round(at)}%" and at == pytest.approx(round(at), abs=1e-9) for text, at in ticks)
    assert 2 <= len(ticks) <= 8


def test_a_line_breaks_where_a_cell_is_missing():
    rows = claimed_table(without=[fixed("sensor", Setup(15, 3))])
    line = next(line for line in figure_3_7(Results(rows)).axes[0].lines if len(line.get_xdata()) == 5)
    assert np.isnan(line.get_ydata()).tolist() == [False, False, True, False, False]


def test_heatmap_holds_every_number(results: Results):
    for axes, method in zip(heatmap(results).axes, DISSERTATION_METHODS, strict=True):
        table = {"sensor": SENSOR_SUCCESS, "out": OUT_SUCCESS}.get(method, dict.fromkeys(ROBOTS, (IN_SUCCESS,) * 5))
        written = {tuple(map(round, text.get_position())): text.get_text() for text in axes.texts[::2]}
        wanted = {(x, y): f"{table[n][x]:.1f}" for y, n in enumerate(ROBOTS) for x in range(5)}
        assert written == wanted, method


def test_heatmap_marks_a_missing_cell():
    axes = heatmap(Results(claimed_table(without=[fixed("out", Setup(5, 8))]))).axes[2]
    assert [text.get_position() for text in axes.texts if text.get_text() == "–"] == [(4, 0)]


def seeds_drawn(figure: Figure) -> int:
    return sum(line.get_marker() == "o" and len(line.get_xdata()) == 2 for line in figure.axes[0].lines)


def test_the_range_over_seeds_is_shown_if_there_are_several(results: Results):
    other = Results([*claimed_table(), fixed("sensor", Setup(10, 1), success=60)._replace(seed=1)])
    assert (seeds_drawn(figure_3_4(results)), seeds_drawn(figure_3_4(other))) == (0, 1)


@pytest.mark.parametrize("picture", PICTURES, ids=lambda picture: picture.file)
def test_files_are_small_and_reproducible(picture: Picture, results: Results, tmp_path: Path):
    first, second = tmp_path / "first.png", tmp_path / "second.png"
    for path in (first, second):
        save_png(picture.draw(results), path)
    assert first.read_bytes() == second.read_bytes()
    assert first.stat().st_size <= 60 * 1024
    assert b"Software" not in first.read_bytes() and b"tEXt" not in first.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["first.png", "second.png"]


@pytest.mark.parametrize("picture", PICTURES, ids=lambda picture: picture.file)
def test_missing_data_are_stated_in_the_picture(picture: Picture, tmp_path: Path):
    figure: Figure = picture.draw(Results([]))
    save_png(figure, tmp_path / "empty.png")
    texts = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert "no data" in texts or texts.count("–") == 3 * len(SETUPS)


def test_the_reduced_palette_keeps_the_colours(results: Results, tmp_path: Path):
    save_png(figure_4_4(results), tmp_path / "few.png")
    image = matplotlib.image.imread(tmp_path / "few.png")[..., :3]
    for colour, *_ in STYLES[:3]:
        near = np.abs(image - np.array(matplotlib.colors.to_rgb(colour))).max(axis=-1) < 0.03
        assert near.sum() > 500, colour


def test_titles_are_plain_text(tmp_path: Path):
    save_png(new_figure(2.0, 1.0, r"$\frac{1$"), tmp_path / "title.png")


def test_pyplot_is_not_used(results: Results):
    from matplotlib import pyplot

    figure_3_7(results)
    assert pyplot.get_fignums() == []
