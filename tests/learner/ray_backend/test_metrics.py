"""Rows of a run as Ray metrics; in tests/integration a real Prometheus reads them."""

import math

import pytest

from learner.ray_backend import metrics as ray_metrics
from learner.ray_backend.metrics import RayMetrics
from learner.tracking.journal import Row
from learner.tracking.metric_names import METRICS


class Told:
    """Stands in for Ray's Gauge and Counter; records what is set or added under the metric's name."""

    calls: list[tuple[str, float, dict[str, str]]] = []

    def __init__(self, name, description, tag_keys):
        self.name, self.tag_keys = name, tag_keys

    def set(self, value, tags):
        assert tuple(tags) == self.tag_keys
        self.calls.append((self.name, value, tags))

    def inc(self, value, tags):
        assert value > 0, "Ray's counters refuse others"
        self.set(value, tags)


@pytest.fixture
def told(monkeypatch):
    """Function: what was set or added since the last call, as {name: value}."""
    monkeypatch.setattr(ray_metrics, "Gauge", Told)
    monkeypatch.setattr(ray_metrics, "Counter", Told)
    monkeypatch.setattr(Told, "calls", [])

    def take():
        found = {name: value for name, value, _ in Told.calls}
        assert len(found) == len(Told.calls), "told twice of one row"
        assert all(tags == {"run": "r"} for _, _, tags in Told.calls)
        Told.calls.clear()
        return found

    return take


def test_gauges_show_the_newest_values_and_counters_what_was_added(told):
    metrics = RayMetrics("r")
    metrics.row(Row(100, 0, {"train/epsilon": 0.5, "account/updates": 8}))
    assert told() == {"shoal_epsilon": 0.5, "shoal_env_steps": 100, "shoal_updates": 8}
    metrics.row(Row(150, 0, {"train/epsilon": 0.4, "account/updates": 12, "account/episodes": 3}))
    assert told() == {"shoal_epsilon": 0.4, "shoal_env_steps": 50, "shoal_updates": 4, "shoal_episodes": 3}


def test_values_of_earlier_rows_are_exported_again_because_ray_drops_them(told):
    metrics = RayMetrics("r")
    metrics.row(Row(100, 0, {"eval/success_rate": 0.25}))
    told()
    metrics.row(Row(200, 0, {"train/loss": 1.5}))
    assert told() == {"shoal_eval_success_rate": 0.25, "shoal_loss": 1.5, "shoal_env_steps": 100}


def test_the_row_of_an_earlier_evaluation_decreases_no_counter(told):
    metrics = RayMetrics("r")
    metrics.row(Row(300, 0, {"account/updates": 8}))
    metrics.row(Row(200, 0, {"eval/return": 1.0}))
    metrics.row(Row(350, 0, {"account/updates": 9}))
    added = [(name, value) for name, value, _ in Told.calls if name == "shoal_env_steps"]
    assert added == [("shoal_env_steps", 300), ("shoal_env_steps", 50)]


def test_values_that_are_not_finite_are_not_exported(told):
    RayMetrics("r").row(Row(1, 0, {"replay/samples_per_insert": math.nan, "train/loss": math.inf}))
    assert told() == {"shoal_env_steps": 1}


def test_every_metric_of_the_table_is_exported(told):
    metrics = {known.journal: 1.0 for known in METRICS}
    RayMetrics("r").row(Row(1, 0, metrics))
    assert set(told()) == {known.name for known in METRICS}
