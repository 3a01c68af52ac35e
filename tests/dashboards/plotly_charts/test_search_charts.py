"""The charts of a search."""

from dashboards.plotly_charts.chart import as_json
from dashboards.plotly_charts.search_charts import front_chart, importances_chart, progress_chart, slices_chart
from tests.dashboards.figures.test_search_figure import ONE, TWO, summary


def panels(chart, view=""):
    return [panel.figure["data"] for panel in chart.views[view].panels]


def test_progress_has_every_complete_trial_and_the_best_so_far():
    ((points, best),) = panels(progress_chart(ONE))
    assert (points["x"], points["y"]) == ([0, 2, 3], [0.5, 0.9, 0.7])
    assert (best["x"], best["y"]) == ([0, 2, 3], [0.5, 0.9, 0.9])
    assert points["customdata"][1] == "trial 2<br>success 90.0 %<br>learning_rate 0.003"
    table = progress_chart(ONE).views[""].table
    assert table.header == ("trial", "state", "success", "learning_rate")
    assert table.rows[1] == ("1", "failed", "–", "0.002") and table.rows[2] == ("2", "complete", "90.0 %", "0.003")


def test_importances_are_bars_the_largest_on_top():
    ((bars,),) = panels(importances_chart(ONE))
    assert (bars["y"], bars["x"]) == (["n_step", "learning_rate"], [0.25, 0.75])
    assert importances_chart(summary(["a"], [True], [(1.0,)], [{}])).views == {}


def test_a_front_needs_two_objectives():
    assert front_chart(ONE).views == {}
    ((points, front),) = panels(front_chart(TWO))
    assert len(points["x"]) == 3 and (front["x"], front["y"]) == ([0.7, 0.9], [5e4, 8e4])
    assert [row[0] for row in front_chart(TWO).views[""].table.rows] == ["1", "2"]


def test_every_setting_has_its_view_on_its_own_scale():
    chart = slices_chart(TWO)
    assert list(chart.views) == ["learning_rate"] and len(chart.views["learning_rate"].panels) == 2
    layout = chart.views["learning_rate"].panels[0].figure["layout"]
    assert layout["xaxis"]["type"] == "log"
    assert as_json(chart)["choices"][0]["default"] == "learning_rate"
    assert slices_chart(summary(["a"], [True], [])).views == {}
