"""Which pods can connect to the pods of Ray and MLflow under the network policies."""

import pytest

from tests.deploy.manifests import documents

POLICIES = [document for document in documents().values() if document["kind"] == "NetworkPolicy"]
OURS = {"app.kubernetes.io/part-of": "shoal"}
RAY = {**OURS, "ray.io/is-ray-node": "yes"}  # the second label is KubeRay's
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
    assert policies, "a pod without a policy accepts all connections"

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
        ({}, True, {DASHBOARD}),  # a job's submitter, which sends the token
        ({}, False, set()),
        (MLFLOW, True, {DASHBOARD}),
        (PROMETHEUS, False, {METRICS}),
        (OPERATOR, False, {DASHBOARD}),
    ],
)
def test_ray_pods_reach_each_other_and_others_reach_one_port(labels, at_home, ports):
    assert {port for port in (GCS, DASHBOARD, METRICS, 12_345) if admits(RAY, port, labels, at_home)} - {
        12_345
    } == ports
    assert admits(RAY, 12_345, labels, at_home) == (labels == RAY and at_home)


@pytest.mark.parametrize(("labels", "at_home"), [({}, True), (RAY, True), ({}, False), (PROMETHEUS, False)])
def test_only_its_namespace_reaches_mlflow(labels, at_home):
    assert admits(MLFLOW, SERVER, labels, at_home) == at_home
