"""Queries of the Grafana dashboard and the alerts, and the metrics that they name."""

import json
import re
from pathlib import Path

import promql_parser
import yaml

from learner.tracking.metric_names import METRICS

ROOT = Path(__file__).parents[2]
DASHBOARD = ROOT / "dashboards" / "grafana" / "shoal.json"
ALERTS = ROOT / "deploy" / "prometheus" / "alerts.yml"
OURS = {known.series for known in METRICS}


def dashboard():
    """The dashboard as Grafana reads it."""
    return json.loads(DASHBOARD.read_text())


def dashboard_queries(data, interval: str = "1m", run: str = ".*"):
    """{panel's title: expressions}, with Grafana's variables filled in."""
    values = {"$__rate_interval": interval, "$run": run}
    return {
        panel["title"]: [_filled(target["expr"], values) for target in panel.get("targets", [])]
        for panel in data["panels"]
    }


def _filled(expression: str, values: dict[str, str]) -> str:
    for name, value in values.items():
        expression = expression.replace(name, value)
    assert "$" not in expression, f"an unknown variable in {expression}"
    return expression


def variable_metrics(data) -> set[str]:
    """Metrics that the dashboard's variables ask for."""
    queries = [item["query"] for item in data["templating"]["list"] if item["type"] == "query"]
    return {re.fullmatch(r"label_values\((\w+), \w+\)", query)[1] for query in queries}


def alert_queries():
    """{alert's name: expression}."""
    (group,) = yaml.safe_load(ALERTS.read_text())["groups"]
    return {rule["alert"]: rule["expr"] for rule in group["rules"]}


def metric_names(expression: str) -> set[str]:
    """Names of the metrics that a PromQL expression selects.

    Raises:
      ValueError: it is no PromQL, or selects without a name.
    """
    names: set[str] = set()

    def visit(node):
        if isinstance(node, promql_parser.VectorSelector):
            if node.name is None:
                raise ValueError(f"a selector without a name in {expression}")
            names.add(node.name)

    promql_parser.walk(promql_parser.parse(expression), visit)
    return names
