"""The picture of a search."""

import pytest
from PIL import Image

from dashboards.analysis.searches import SearchedTrial, SearchSummary, setting_text, value_text
from dashboards.figures.search_figure import search_figure
from dashboards.figures.style import save_png


def summary(objectives, minimised, values, importances=None):
    """A search whose trial i has the learning rate 0.001 (i + 1) and the i-th values, None for a failed one."""
    trials = [
        SearchedTrial(i, {"learning_rate": 1e-3 * (i + 1)}, "failed" if each is None else "complete", each or ())
        for i, each in enumerate(values)
    ]
    front = [i for i, each in enumerate(values) if each is not None][-2:]
    shares = importances or [{"learning_rate": 0.75, "n_step": 0.25}] * len(objectives)
    return SearchSummary(objectives, minimised, trials, front, shares, frozenset({"learning_rate"}))


ONE = summary(["success"], [False], [(0.5,), None, (0.9,), (0.7,)])
TWO = summary(["success", "steps_to=0.9"], [False, True], [(0.5, 9e4), (0.9, 8e4), (0.7, 5e4)])


def test_the_best_so_far_is_of_complete_trials_and_of_the_better_direction():
    assert ONE.best_so_far(0) == [(0, 0.5), (2, 0.9), (3, 0.9)]
    assert TWO.best_so_far(1) == [(0, 9e4), (1, 8e4), (2, 5e4)]


def test_progress_and_importances_are_drawn_for_each_objective():
    progress, importances = search_figure(ONE, "t").axes
    assert progress.collections[0].get_offsets().tolist() == [[0, 0.5], [2, 0.9], [3, 0.7]]
    assert progress.lines[0].get_ydata().tolist() == [0.5, 0.9, 0.9]
    widths = {
        label.get_text(): bar.get_width()
        for label, bar in zip(importances.get_yticklabels(), importances.patches, strict=True)
    }
    assert widths == {"n_step": 0.25, "learning_rate": 0.75}


def test_several_objectives_have_a_front():
    *_, front = search_figure(TWO, "t").axes
    assert front.get_title(loc="left") == "front"
    assert front.lines[0].get_xydata().tolist() == [[0.7, 5e4], [0.9, 8e4]]
    assert len(front.collections[0].get_offsets()) == 3


@pytest.mark.parametrize(
    "found", [ONE, TWO, summary(["a", "b"], [True, True], [None], [{}, {}]), summary(["a"], [True], [])]
)
def test_any_search_can_be_drawn(found, tmp_path):
    save_png(search_figure(found, "Search $x"), tmp_path / "s.png")
    with Image.open(tmp_path / "s.png") as image:
        assert image.size[0] > 600


def test_values_are_written_as_their_kind():
    assert [value_text("worst", 0.987), value_text("steps_to=0.9", 123456.0), value_text("claims", 1.23456)] == [
        "98.7 %", "123,456", "1.235",
    ]  # fmt: skip
    assert [setting_text(0.00123456), setting_text(3), setting_text("mse")] == ["0.001235", "3", "mse"]
