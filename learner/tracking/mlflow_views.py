"""Saved views of an experiment in the MLflow UI: the whole grid, and by method, robots, groups and share of learners.

MLflow has no API for views. Its UI stores one as a tag of the experiment with compressed JSON, and MLflow's own demo
(`mlflow.demo.generators.saved_views`) writes such tags with `set_experiment_tag`, as this module does. The format may
change with MLflow's version, and tests hold it against the installed one. Everything works without views.
"""

from __future__ import annotations

import base64
import json
import zlib
from typing import Any

TAG = "mlflow.sharedViewState."
"""Prefix of a view's tag; the rest is the view's key."""
SETUP_PARAMS = ("method", "robots", "groups")
FAILURES = ("lost", "captured", "collision", "timeout")
TEAM = ("all_arrive_rate", "segregation")
"""Metrics of runs in which several robots of a world learn."""


def _chart(kind: str, section: str, name: str, **settings: Any) -> dict[str, Any]:
    base = {"runsCountToCompare": 300, "deleted": False, "isGenerated": False, "displayName": name}
    return {"uuid": f"{section}-{name}", "type": kind, "metricSectionId": section, **base, **settings}


def _bar(section: str, metric: str) -> dict[str, Any]:
    return _chart("BAR", section, metric, metricKey=metric)


def _line(section: str, metric: str) -> dict[str, Any]:
    axes = {"xAxisKey": "step", "selectedXAxisMetricKey": "", "xAxisScaleType": "linear", "scaleType": "linear"}
    values = {"yAxisKey": "metric", "yAxisExpressions": [], "range": {}, "lineSmoothness": 0, "ignoreOutliers": False}
    shared = {"useGlobalXaxisKey": True, "useGlobalLineSmoothing": True}
    return _chart("LINE", section, metric, metricKey=metric, selectedMetricKeys=[metric], **axes, **values, **shared)


def _section(uuid: str, name: str) -> dict[str, Any]:
    return {
        "uuid": uuid,
        "name": name,
        "display": True,
        "isReordered": True,
        "deleted": False,
        "isGenerated": False,
    }


def _state(charts: dict[str, list[dict[str, Any]]], *group_by: str) -> dict[str, Any]:
    """The state that the UI stores for a view.

    Args:
      charts: by name of their section.
      *group_by: the params that runs are grouped by.
    """
    keys = [{"mode": "param", "groupByData": param} for param in group_by]
    metrics = ["final/success_rate", *(f"final/{failure}_rate" for failure in FAILURES)]
    return {
        "searchFilter": "tags.policy = 'learned'",
        "orderByKey": "metrics.`final/success_rate`",
        "orderByAsc": False,
        "startTime": "ALL",
        "lifecycleFilter": "Active",
        "datasetsFilter": [],
        "modelVersionFilter": "All Runs",
        "selectedColumns": [f"params.`{p}`" for p in (*SETUP_PARAMS, "learners", "seed")]
        + [f"metrics.`{m}`" for m in metrics],
        "columnOrder": [],
        "columnWidths": {},
        "runsHiddenMode": "SHOWALL",
        "viewMaximized": False,
        "runListHidden": False,
        "isAccordionReordered": True,
        "useGroupedValuesInCharts": True,
        "hideEmptyCharts": True,
        "groupBy": {"aggregateFunction": "average", "groupByKeys": keys} if group_by else None,
        "groupsExpanded": {},
        "globalLineChartConfig": {"xAxisKey": "step", "lineSmoothness": 0, "selectedXAxisMetricKey": ""},
        "compareRunSections": [_section(name.lower(), name) for name in charts],
        "compareRunCharts": [chart for section in charts.values() for chart in section],
    }


def experiment_views() -> dict[str, tuple[str, dict[str, Any]]]:
    """The views of an experiment: (name in the UI, state) by key."""

    def param(key: str) -> dict[str, str]:
        return {"key": key, "type": "PARAM"}

    success = {"key": "final/success_rate", "type": "METRIC"}
    grid = [
        _chart(
            "PARALLEL",
            "grid",
            "method × robots × groups",
            selectedParams=list(SETUP_PARAMS),
            selectedMetrics=["final/success_rate"],
            showAllRuns=True,
        ),
        _chart("CONTOUR", "grid", "success", xaxis=param("robots"), yaxis=param("groups"), zaxis=success),
        _bar("grid", "final/success_rate"),
    ]
    curves = [_line("curves", "eval/success_rate"), _line("curves", "train/success_rate")]
    failures = [_bar("failures", f"final/{failure}_rate") for failure in FAILURES]
    by = {
        name: _state({"Grid": [_bar("grid", "final/success_rate")], "Failures": failures, "Curves": curves}, name)
        for name in ("method", "robots", "groups")
    }
    by_learners = {
        "Success": [_bar("success", "final/success_rate")],
        "Team": [_bar("team", f"final/{name}") for name in TEAM],
        "Failures": failures,
        "Curves": curves,
    }
    return {
        "grid": ("1 Grid", _state({"Grid": grid, "Curves": curves})),
        "by-method": ("2 By method", by["method"]),
        "by-robots": ("3 By robots", by["robots"]),
        "by-groups": ("4 By groups", by["groups"]),
        "by-learners": ("5 By learners", _state(by_learners, "learners", "method")),
    }


def packed_view(name: str, state: dict[str, Any], time_ms: int) -> str:
    """The value of a view's tag.

    Args:
      name: the view's name in the UI.
      state: one of `experiment_views`.
      time_ms: its creation, in ms since the epoch.
    """
    packed = base64.b64encode(zlib.compress(json.dumps(state).encode())).decode()
    return json.dumps({"name": name, "createdAt": time_ms, "updatedAt": time_ms, "state": f"deflate;{packed}"})
