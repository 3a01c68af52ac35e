"""The Grafana dashboard and the alerts: every query names an existing metric, and Grafana's schema accepts the rest."""

import copy
import json
import re
from importlib import resources

import pytest
import yaml
from grafana_foundation_sdk.cog.encoder import JSONEncoder
from grafana_foundation_sdk.cog.plugins import register_default_plugins
from grafana_foundation_sdk.models.dashboard import Dashboard

from tests.dashboards.promql import (
    DASHBOARD,
    OURS,
    alert_queries,
    dashboard,
    dashboard_queries,
    metric_names,
    variable_metrics,
)

PROVISIONING = DASHBOARD.parent / "provisioning"
GROUPS = ["Throughput", "Learning", "Replay", "Health", "Accounts"]


def rays_own() -> set[str]:
    """Metrics that Ray's own dashboards show, and Prometheus' `up`."""
    panels = resources.files("ray.dashboard.modules.metrics.dashboards") / "default_dashboard_panels.py"
    return set(re.findall(r"\bray_\w+", panels.read_text())) | {"up"}


def unknown(queries) -> set[str]:
    known = OURS | rays_own()
    return {name for expressions in queries.values() for text in expressions for name in metric_names(text)} - known


def test_every_query_names_a_metric_that_exists():
    queries = dashboard_queries(dashboard())
    assert sum(map(len, queries.values())) > 30
    assert not unknown(queries)
    assert variable_metrics(dashboard()) == {"ray_shoal_env_steps_total"}
    assert not unknown({name: [text] for name, text in alert_queries().items()})


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("ray_shoal_env_steps_total", "ray_shoal_env_step_total"),
        ("ray_shoal_epsilon", "ray_shoal_epsilon_total"),
        ("ray_node_cpu_utilization", "ray_node_cpu_utilisation"),
    ],
)
def test_a_misspelt_metric_is_found(name, wrong):
    text = DASHBOARD.read_text()
    assert name in text
    assert unknown(dashboard_queries(json.loads(re.sub(rf"{name}\b", wrong, text)))) == {wrong}


def test_invalid_queries_are_found():
    with pytest.raises(ValueError, match="unclosed left parenthesis"):
        metric_names("sum by (run) (rate(ray_shoal_env_steps_total[1m])")
    with pytest.raises(ValueError, match="without a name"):
        metric_names('sum({run="a"})')


def test_every_gauge_is_on_the_dashboard_or_left_out_on_purpose():
    shown = {name for texts in dashboard_queries(dashboard()).values() for text in texts for name in metric_names(text)}
    failures = ("lost", "captured", "collision", "timeout")
    left_out = {f"ray_shoal_eval_{name}_rate_{end}" for name in failures for end in ("low", "high")}
    left_out |= {"ray_shoal_eval_return_low", "ray_shoal_eval_return_high"}
    shares = ("all_arrive_rate", "learner_collision_rate")  # of teams: only where several robots of a world learn
    left_out |= {f"ray_shoal_eval_{name}{end}" for name in shares for end in ("", "_low", "_high")}
    left_out |= {"ray_shoal_eval_last_arrival_steps", "ray_shoal_eval_segregation"}
    left_out |= {f"ray_shoal_eval_{name}_{of}" for name in ("q", "return") for of in ("start", "visited")}
    assert OURS - shown == left_out


def grafanas_view(data):
    """The dashboard, read and written by Grafana's own classes, which drop unknown fields."""
    register_default_plugins()
    return json.loads(json.dumps(Dashboard.from_json(copy.deepcopy(data)), cls=JSONEncoder))


def lost(given, kept, way="$") -> list[str]:
    """Fields of `given` that are missing or different in `kept`."""
    if isinstance(given, dict) and isinstance(kept, dict):
        return [
            found
            for key, value in given.items()
            for found in (lost(value, kept[key], f"{way}.{key}") if key in kept else [f"{way}.{key}"])
        ]
    if isinstance(given, list) and isinstance(kept, list) and len(given) == len(kept):
        pairs = zip(given, kept, strict=True)
        return [found for i, (one, other) in enumerate(pairs) for found in lost(one, other, f"{way}[{i}]")]
    return [] if given == kept else [way]


def test_grafana_knows_every_field():
    assert lost(dashboard(), grafanas_view(dashboard())) == []


@pytest.mark.parametrize(("name", "wrong"), [("expr", "exprs"), ("gridPos", "gridpos"), ("legendFormat", "legend")])
def test_a_misspelt_field_is_found(name, wrong):
    spoilt = json.loads(DASHBOARD.read_text().replace(f'"{name}"', f'"{wrong}"'))
    found = lost(spoilt, grafanas_view(spoilt))
    assert found and all(path.endswith(wrong) for path in found)


def test_panels_are_in_their_groups_and_do_not_overlap():
    panels = dashboard()["panels"]
    assert [panel["title"] for panel in panels if panel["type"] == "row"] == GROUPS
    assert len({panel["id"] for panel in panels}) == len(panels)
    taken = set()
    for panel in panels:
        place = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert place["x"] + place["w"] <= 24 and not cells & taken
        taken |= cells
        assert panel["type"] == "row" or panel["description"], "a panel's description says what is healthy"


def test_provisioning_fits_the_dashboard():
    (source,) = yaml.safe_load((PROVISIONING / "datasources" / "prometheus.yml").read_text())["datasources"]
    assert (source["type"], source["access"]) == ("prometheus", "proxy")
    (variable,) = [item for item in dashboard()["templating"]["list"] if item["type"] == "datasource"]
    assert variable["query"] == source["type"] and variable["current"]["value"] == source["uid"]
    for panel in dashboard()["panels"]:
        assert panel["type"] == "row" or panel["datasource"] == {"type": source["type"], "uid": "${datasource}"}
    (provider,) = yaml.safe_load((PROVISIONING / "dashboards" / "shoal.yml").read_text())["providers"]
    assert provider["type"] == "file" and provider["options"]["path"].startswith("/")
