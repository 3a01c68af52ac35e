"""Views of an experiment: they name what runs log, in the format that the installed MLflow UI reads."""

import base64
import json
import zlib
from pathlib import Path

import mlflow
import pytest
from mlflow.utils.validation import MAX_EXPERIMENT_TAG_VAL_LENGTH

from learner.config import RunConfig, flat_params
from learner.tracking.mlflow_run import Tracker
from learner.tracking.mlflow_views import TAG, TEAM, experiment_views, packed_view
from learner.training.evaluation_summary import outcome_label
from sim_core.outcomes import ENDED

pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy is deprecated")

LOGGED = {f"final/{outcome_label(kind)}" for kind in ENDED} | {"eval/success_rate", "train/success_rate"}
LOGGED |= {"final/all_arrive_rate", "final/segregation"}


def unpack(value):
    kind, _, packed = json.loads(value)["state"].partition(";")
    assert kind == "deflate"
    return json.loads(zlib.decompress(base64.b64decode(packed)))


@pytest.mark.parametrize("key", experiment_views())
def test_a_view_shows_what_runs_log(key):
    name, state = experiment_views()[key]
    params = flat_params(RunConfig()).keys()
    columns = [column.split("`")[1] for column in state["selectedColumns"]]
    assert set(columns) <= LOGGED | params and "final/success_rate" in columns
    for chart in state["compareRunCharts"]:
        named = [chart[axis]["key"] for axis in ("xaxis", "yaxis", "zaxis") if axis in chart]
        named += chart.get("selectedParams", []) + chart.get("selectedMetrics", []) + [chart.get("metricKey")]
        assert set(named) - {None} <= LOGGED | params
        assert chart["metricSectionId"] in {section["uuid"] for section in state["compareRunSections"]}
    if state["groupBy"]:
        assert {group["groupByData"] for group in state["groupBy"]["groupByKeys"]} <= params
    uuids = [chart["uuid"] for chart in state["compareRunCharts"]]
    assert len(uuids) == len(set(uuids)) and len(name) > 0


@pytest.mark.parametrize("key", experiment_views())
def test_a_packed_view_fits_into_a_tag(key):
    assert len(packed_view(*experiment_views()[key], 10**13)) <= MAX_EXPERIMENT_TAG_VAL_LENGTH


def test_the_installed_ui_reads_views_from_this_tag():
    scripts = (Path(mlflow.__file__).parent / "server/js/build/static/js").glob("*.js")
    assert any(TAG in script.read_text() for script in scripts)


def test_a_packed_view_unpacks_to_itself():
    name, state = experiment_views()["grid"]
    value = packed_view(name, state, 1234)
    assert json.loads(value)["name"] == name and json.loads(value)["createdAt"] == 1234
    assert unpack(value) == json.loads(json.dumps(state))


def test_an_experiment_gets_the_views_when_it_is_made_and_they_show_trainings(tmp_path):
    uri = f"sqlite:///{tmp_path / 'mlflow.db'}"
    tracker = Tracker(uri, "sweep s", str(tmp_path / "artifacts"))
    tracker.start(RunConfig())
    tags = mlflow.MlflowClient(uri).get_experiment_by_name("sweep s").tags
    assert {key.removeprefix(TAG) for key in tags if key.startswith(TAG)} == experiment_views().keys()
    assert unpack(tags[f"{TAG}by-method"])["groupBy"]["groupByKeys"] == [{"mode": "param", "groupByData": "method"}]
    Tracker(uri, "sweep s", str(tmp_path / "artifacts"))
    assert mlflow.MlflowClient(uri).get_experiment_by_name("sweep s").tags == tags  # it is not made a second time
    client = mlflow.MlflowClient(uri)
    experiment = client.get_experiment_by_name("sweep s").experiment_id
    for _, state in experiment_views().values():
        assert [run.info.run_id for run in client.search_runs([experiment], state["searchFilter"])] == [tracker.run_id]


def test_runs_are_grouped_by_their_share_of_learners_and_show_what_teams_do():
    _, state = experiment_views()["by-learners"]
    assert [key["groupByData"] for key in state["groupBy"]["groupByKeys"]] == ["learners", "method"]
    assert {f"final/{name}" for name in TEAM} <= {chart.get("metricKey") for chart in state["compareRunCharts"]}
