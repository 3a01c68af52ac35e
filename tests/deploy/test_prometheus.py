"""Prometheus' configuration and alerts, checked by promtool."""

import shutil
import subprocess

import pytest

from tests.deploy.manifests import PROMETHEUS, PROMTOOL, cluster_spec, documents, read_yaml

needs_promtool = pytest.mark.skipif(PROMTOOL is None, reason="promtool is not on PATH (apt-get install prometheus)")
CONFIGS = ["prometheus.yml", "prometheus-kubernetes.yml"]


def check(folder, name):
    return subprocess.run([PROMTOOL, "check", "config", folder / name], capture_output=True, text=True, check=False)


@needs_promtool
@pytest.mark.parametrize("name", CONFIGS)
def test_prometheus_accepts_the_configuration_and_its_alerts(name):
    done = check(PROMETHEUS, name)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "4 rules found" in done.stdout


@needs_promtool
@pytest.mark.parametrize(
    ("name", "right", "wrong"),
    [
        ("prometheus.yml", "file_sd_configs", "file_sd_config"),
        ("prometheus-kubernetes.yml", "dns_sd_configs", "dns_configs"),
        ("alerts.yml", "annotations", "annotation"),
        ("alerts.yml", "sum(rate(", "sum(rat("),
    ],
)
def test_misspelt_settings_are_found(tmp_path, name, right, wrong):
    for path in PROMETHEUS.glob("*.yml"):
        shutil.copy(path, tmp_path)
    text = (PROMETHEUS / name).read_text()
    assert right in text
    (tmp_path / name).write_text(text.replace(right, wrong))
    done = check(tmp_path, name if name in CONFIGS else CONFIGS[0])
    assert done.returncode != 0


@needs_promtool
@pytest.mark.parametrize(
    ("steps", "state", "fires"),
    [("0+100x30", "ALIVE_IDLE", False), ("5000+0x30", "ALIVE_IDLE", True), ("5000+0x30", "DEAD", False)],
)
def test_a_learner_without_progress_raises_the_alert(tmp_path, steps, state, fires):
    alert = "{exp_labels: {severity: page}, exp_annotations: {summary: SUMMARY}}"
    (group,) = read_yaml(PROMETHEUS / "alerts.yml")[0]["groups"]
    (rule,) = [rule for rule in group["rules"] if rule["alert"] == "ShoalStandsStill"]
    (tmp_path / "test.yml").write_text(
        f"""
rule_files: [{PROMETHEUS / "alerts.yml"}]
evaluation_interval: 1m
tests:
  - interval: 1m
    input_series:
      - {{series: 'ray_shoal_env_steps_total{{run="r"}}', values: '{steps}'}}
      - {{series: 'ray_actors{{Name="LearnerActor",State="{state}"}}', values: '1x30'}}
    alert_rule_test:
      - eval_time: 25m
        alertname: ShoalStandsStill
        exp_alerts: [{alert.replace("SUMMARY", repr(rule["annotations"]["summary"])) if fires else ""}]
"""
    )
    done = subprocess.run(
        [PROMTOOL, "test", "rules", tmp_path / "test.yml"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_scraped_kubernetes_service_selects_rays_pods():
    manifests = documents()
    (config,) = read_yaml(PROMETHEUS / "prometheus-kubernetes.yml")
    (places,) = config["scrape_configs"][0]["dns_sd_configs"]
    (name,) = places["names"]
    service = manifests[f"Service/{name}"]["spec"]
    assert service["clusterIP"] == "None", "a headless service: its name resolves to every pod"
    (port,) = service["ports"]
    assert port["port"] == places["port"]
    spec = cluster_spec(manifests["RayCluster/shoal"])
    for group in (spec["headGroupSpec"], *spec["workerGroupSpecs"]):
        labels = group["template"]["metadata"]["labels"] | {"ray.io/is-ray-node": "yes"}  # KubeRay adds the second
        assert service["selector"].items() <= labels.items()
        assert group["rayStartParams"]["metrics-export-port"] == str(places["port"])
        ports = {known["name"]: known["containerPort"] for known in group["template"]["spec"]["containers"][0]["ports"]}
        assert ports[port["targetPort"]] == places["port"]
