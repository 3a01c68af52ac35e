"""The report of a search: found by its name, it shows the study as it is now."""

import pytest

from dashboards.pages.report_page import report_data, report_page
from deploy.report_data.search_source import SearchSource
from deploy.report_data.sources import find_report_source
from learner.search.config import SearchConfig
from learner.search.study import SearchStudy

SEARCH = SearchConfig(space=("learning_rate=1e-4..1e-2:log", "loss=huber,mse"), objective=("success", "steps_to=0.9"))


@pytest.fixture
def study(tmp_path):
    folder = tmp_path / "runs/searches/mine"
    folder.mkdir(parents=True)
    return SearchStudy(folder, SEARCH, [False, True], [])


def test_a_search_is_found_by_its_name_and_folder(study, tmp_path):
    runs = tmp_path / "runs"
    for name in ("mine", str(runs / "searches/mine")):
        found = find_report_source(name, runs)
        assert isinstance(found, SearchSource) and found.title == "Search mine"


def test_the_report_follows_the_study(study, tmp_path):
    source = find_report_source("mine", tmp_path / "runs")
    before = source.fingerprint()
    assert [chart.key for chart in source.contents().charts] == ["search", "front"], "nothing is known yet"
    for place in range(6):
        asked = study.ask()
        study.complete(asked.number, [0.5 + 0.05 * place, 9e4 - 1e4 * (place % 3)])
    study.fail(study.ask().number, "it broke")
    assert source.fingerprint() != before
    contents = source.contents()
    assert [chart.key for chart in contents.charts] == ["search", "front", "importances", "slices"]
    assert contents.facts == [
        ("trials", "7"),
        ("complete", "6"),
        ("failed", "1"),
        ("best success", "75.0 %"),
        ("best steps_to=0.9", "70,000"),
    ]
    assert contents.charts[0].views[""].table.rows[6][1] == "it broke"
    data = report_data(contents)
    assert data["order"].index("front") < data["order"].index("claims")
    assert "Search mine" in report_page(source.title, data, {}, live=False)
