"""Views of a sweep's experiment: they name what runs log, in the format that the installed MLflow UI reads."""

import base64
import json
import zlib
from pathlib import Path

import mlflow
import pytest
from mlflow.utils.validation import MAX_EXPERIMENT_TAG_VAL_LENGTH

from learner.config import RunConfig, flat_params
from learner.tracking.mlflow_run import Tracker
from learner.tracking.mlflow_views import TAG, packed_view, sweep_views
from learner.training.evaluation_summary import outcome_label
from sim_core.outcomes import ENDED

pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy is deprecated")

LOGGED = {f"final/{outcome_label(kind)}" for kind in ENDED} | {"eval/success_rate", "train/success_rate"}


def unpack(value):
    kind, _, packed = json.loads(value)["state"].partition(";")
    assert kind == "deflate"
    return json.loads(zlib.decompress(base64.b64decode(packed)))


@pytest.mark.parametrize("key", sweep_views())
def test_a_view_shows_what_runs_log(key):
    name, state = sweep_views()[key]
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


@pytest.mark.parametrize("key", sweep_views())
def test_a_packed_view_fits_into_a_tag(key):
    assert len(packed_view(*sweep_views()[key], 10**13)) <= MAX_EXPERIMENT_TAG_VAL_LENGTH


def test_the_installed_ui_reads_views_from_this_tag():
    scripts = (Path(mlflow.__file__).parent / "server/js/build/static/js").glob("*.js")
    assert any(TAG in script.read_text() for script in scripts)


def test_a_packed_view_unpacks_to_itself():
    name, state = sweep_views()["grid"]
    value = packed_view(name, state, 1234)
    assert json.loads(value)["name"] == name and json.loads(value)["createdAt"] == 1234
    assert unpack(value) == json.loads(json.dumps(state))


def test_an_experiment_gets_the_views(tmp_path):
    uri = f"sqlite:///{tmp_path / 'mlflow.db'}"
    Tracker(uri, "sweep s", str(tmp_path / "artifacts")).set_views()
    tags = mlflow.MlflowClient(uri).get_experiment_by_name("sweep s").tags
    assert {key.removeprefix(TAG) for key in tags if key.startswith(TAG)} == sweep_views().keys()
    assert unpack(tags[f"{TAG}by-method"])["groupBy"]["groupByKeys"] == [{"mode": "param", "groupByData": "method"}]
