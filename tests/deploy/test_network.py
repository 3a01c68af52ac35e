"""Which pods Kubernetes' network policies let through to the pods of Ray and MLflow."""

import pytest

from tests.deploy.manifests import documents

POLICIES = [document for document in documents().values() if document["kind"] == "NetworkPolicy"]
OURS = {"app.kubernetes.io/part-of": "shoal"}
RAY = {**OURS, "ray.io/is-ray-node": "yes"}  # the second is KubeRay's own
MLFLOW = {**OURS, "app.kubernetes.io/name": "shoal-mlflow"}
PROMETHEUS = {"app.kubernetes.io/name": "prometheus"}
OPERATOR = {"app.kubernetes.io/name": "kuberay-operator"}
GCS, DASHBOARD, METRICS, SERVER = 6379, 8265, 8080, 5000


def fits(selector, labels) -> bool:
    assert selector.keys() <= {"matchLabels"}
    return selector.get("matchLabels", {}).items() <= labels.items()


def admits(to, port, labels, at_home) -> bool:
    """Whether a pod with `labels`, in the cluster's namespace or another, reaches a port of a pod with labels `to`."""
    policies = [policy["spec"] for policy in POLICIES if fits(policy["spec"]["podSelector"], to)]
    assert policies, "without a policy for it, a pod is open to all"

    def is_peer(peer) -> bool:
        assert peer.keys() <= {"podSelector", "namespaceSelector"}
        anywhere = "namespaceSelector" in peer
        return (at_home or (anywhere and fits(peer["namespaceSelector"], {}))) and fits(peer["podSelector"], labels)

    rules = [rule for spec in policies for rule in spec["ingress"]]
    return any(
        any(map(is_peer, rule["from"]))
        and (port in [each["port"] for each in rule.get("ports", [])] or "ports" not in rule)
        for rule in rules
    )


@pytest.mark.parametrize(
    ("labels", "at_home", "ports"),
    [
        (RAY, True, {GCS, DASHBOARD, METRICS}),
        (RAY, False, set()),
        ({}, True, {DASHBOARD}),  # a job's submitter, which shows the token
        ({}, False, set()),
        (MLFLOW, True, {DASHBOARD}),
        (PROMETHEUS, False, {METRICS}),
        (OPERATOR, False, {DASHBOARD}),
    ],
)
def test_rays_pods_are_open_to_themselves_and_by_one_port_to_others(labels, at_home, ports):
    assert {port for port in (GCS, DASHBOARD, METRICS, 12_345) if admits(RAY, port, labels, at_home)} - {
        12_345
    } == ports
    assert admits(RAY, 12_345, labels, at_home) == (labels == RAY and at_home)


@pytest.mark.parametrize(("labels", "at_home"), [({}, True), (RAY, True), ({}, False), (PROMETHEUS, False)])
def test_mlflow_is_open_to_its_namespace_alone(labels, at_home):
    assert admits(MLFLOW, SERVER, labels, at_home) == at_home
