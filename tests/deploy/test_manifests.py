"""Kubernetes manifests against Kubernetes' and KubeRay's schemas, and against the rest of the repository."""

import copy
import re
import shlex
import subprocess
import sys
import time
import urllib.error
import urllib.request

import kubernetes_validate
import pytest
from packaging.requirements import Requirement
from ray.scripts.scripts import start as ray_start

from deploy.chaos.processes import free_port
from deploy.cli import parse
from deploy.options.training import Sweep
from tests.deploy.manifests import (
    CRDS,
    RAY_KINDS,
    check_core,
    check_pods,
    cluster_spec,
    crd_errors,
    documents,
    pod_templates,
    with_misspelt,
)
from tests.deploy.project import image_ray_version, project

DOCUMENTS = documents()
RAY = {name: document for name, document in DOCUMENTS.items() if document["kind"] in RAY_KINDS}
CORE = {name: document for name, document in DOCUMENTS.items() if name not in RAY}
needs_crds = pytest.mark.skipif(not CRDS.is_dir(), reason=f"KubeRay's definitions are not in {CRDS}")


def test_objects_named_by_the_operators_page_exist():
    assert set(RAY) == {"RayCluster/shoal", "RayJob/shoal-sweep"}
    assert {"Deployment/shoal-mlflow", "Service/shoal-mlflow", "PersistentVolumeClaim/shoal-runs"} <= set(CORE)


@pytest.mark.parametrize("name", CORE)
def test_core_objects_fit_kubernetes_schema(name):
    check_core(CORE[name])


@pytest.mark.parametrize("name", DOCUMENTS)
def test_pods_fit_kubernetes_schema(name):
    check_pods(DOCUMENTS[name])


@needs_crds
@pytest.mark.parametrize("name", RAY)
def test_ray_objects_fit_kuberays_schema(name):
    assert not crd_errors(RAY[name])


CONTAINER = ("template", "spec", "containers", 0)


@pytest.mark.parametrize(
    ("name", "path", "wrong"),
    [
        ("Deployment/shoal-mlflow", ("spec", *CONTAINER, "readinessProbe"), "readynessProbe"),
        ("Deployment/shoal-mlflow", ("spec", *CONTAINER, "livenessProbe", "httpGet", "path"), "pth"),
        ("Service/shoal-mlflow", ("spec", "ports", 0, "targetPort"), "target_port"),
        ("PersistentVolumeClaim/shoal-runs", ("spec", "accessModes"), "accessMode"),
    ],
)
def test_a_misspelt_field_of_a_core_object_is_found(name, path, wrong):
    with pytest.raises(kubernetes_validate.ValidationError, match=wrong):
        check_core(with_misspelt(CORE[name], path, wrong))


@pytest.mark.parametrize("name", RAY)
@pytest.mark.parametrize("field", ["resources", "volumeMounts"])
def test_a_misspelt_field_of_a_pod_is_found(name, field):
    way = ("spec",) if name == "RayCluster/shoal" else ("spec", "rayClusterSpec")
    document = with_misspelt(RAY[name], (*way, "workerGroupSpecs", 0, *CONTAINER, field), f"{field}x")
    with pytest.raises(kubernetes_validate.ValidationError, match=f"{field}x"):
        check_pods(document)


@needs_crds
@pytest.mark.parametrize(
    ("name", "path", "wrong"),
    [
        ("RayCluster/shoal", ("spec", "authOptions", "mode"), "kind"),
        ("RayCluster/shoal", ("spec", "headGroupSpec", "rayStartParams"), "rayStartParam"),
        ("RayCluster/shoal", ("spec", "workerGroupSpecs", 0, "minReplicas"), "minReplica"),
        ("RayCluster/shoal", ("spec", "headGroupSpec", *CONTAINER, "image"), "imagee"),
        ("RayJob/shoal-sweep", ("spec", "entrypoint"), "entryPoint"),
        ("RayJob/shoal-sweep", ("spec", "rayClusterSpec", "rayVersion"), "rayversion"),
        ("RayJob/shoal-sweep", ("spec", "backoffLimit"), "backOffLimit"),
    ],
)
def test_a_misspelt_field_of_a_ray_object_is_found(name, path, wrong):
    assert any(wrong in error for error in crd_errors(with_misspelt(RAY[name], path, wrong)))


@needs_crds
@pytest.mark.parametrize("value", ["tokens", 3])
def test_a_value_unknown_to_kuberay_is_found(value):
    document = copy.deepcopy(RAY["RayCluster/shoal"])
    document["spec"]["authOptions"]["mode"] = value
    assert any("$.spec.authOptions.mode" in error for error in crd_errors(document))


@pytest.mark.parametrize("name", RAY)
def test_every_ray_requires_the_token_and_has_the_images_version(name):
    spec = cluster_spec(RAY[name])
    assert spec["authOptions"] == {"mode": "token"}
    assert spec["rayVersion"] == image_ray_version()
    (wanted,) = [Requirement(line) for line in project()["dependencies"] if Requirement(line).name == "ray"]
    assert wanted.specifier.contains(spec["rayVersion"])
    known = {option.removeprefix("--") for param in ray_start.params for option in param.opts}
    for group in (spec["headGroupSpec"], *spec["workerGroupSpecs"]):
        assert group["rayStartParams"].keys() <= known


def test_the_job_runs_on_pods_like_the_clusters():
    cluster, job = (pod_templates(RAY[name]) for name in ("RayCluster/shoal", "RayJob/shoal-sweep"))
    assert cluster == job


def test_the_jobs_command_parses():
    command, *arguments = shlex.split(RAY["RayJob/shoal-sweep"]["spec"]["entrypoint"])
    assert command == "shoal"
    parsed = parse(arguments)
    assert isinstance(parsed, Sweep)
    mounts = {mount["mountPath"] for pod in pod_templates(RAY["RayJob/shoal-sweep"]) for mount in mounts_of(pod)}
    assert {str(parsed.launch.runs_dir)} == mounts, "runs lie on the shared volume"


def containers():
    return [
        container for doc in DOCUMENTS.values() for pod in pod_templates(doc) for container in pod["spec"]["containers"]
    ]


def mounts_of(pod):
    return [mount for container in pod["spec"]["containers"] for mount in container["volumeMounts"]]


def test_all_pods_run_our_image_which_names_no_registry():
    assert {container["image"] for container in containers()} == {f"shoal:{project()['version']}"}


def test_volumes_and_services_that_pods_name_exist():
    claims = {doc["metadata"]["name"] for doc in CORE.values() if doc["kind"] == "PersistentVolumeClaim"}
    services = {
        (doc["metadata"]["name"], port["port"])
        for doc in CORE.values()
        if doc["kind"] == "Service"
        for port in doc["spec"]["ports"]
    }
    for document in DOCUMENTS.values():
        for pod in pod_templates(document):
            volumes = {
                volume["name"]: volume["persistentVolumeClaim"]["claimName"] for volume in pod["spec"]["volumes"]
            }
            assert set(volumes.values()) <= claims
            assert {mount["name"] for mount in mounts_of(pod)} == set(volumes)
    for container in containers():
        for variable in container["env"]:
            found = re.fullmatch(r"http://([a-z-]+):(\d+)", variable["value"])
            assert not found or (found[1], int(found[2])) in services


def test_pods_have_resource_limits_and_few_rights():
    for document in DOCUMENTS.values():
        for pod in pod_templates(document):
            assert pod["spec"]["securityContext"]["runAsNonRoot"] is True
    for container in containers():
        assert container["securityContext"]["allowPrivilegeEscalation"] is False
        assert "memory" in container["resources"]["limits"] and "cpu" in container["resources"]["requests"]


def answer(port, path, host):
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers={"Host": host})
    try:
        with urllib.request.urlopen(request, timeout=10) as response:
            return response.status
    except urllib.error.HTTPError as error:
        with error:
            return error.code


@pytest.mark.slow
def test_mlflow_as_the_manifest_starts_it_answers_probes_and_pods(tmp_path):
    (container,) = DOCUMENTS["Deployment/shoal-mlflow"]["spec"]["template"]["spec"]["containers"]
    port = free_port()
    moved = {"--host=0.0.0.0": "--host=127.0.0.1", "--port=5000": f"--port={port}"}
    arguments = [moved.get(text, text.replace("/mlflow/", f"{tmp_path}/")) for text in container["args"]]
    assert set(moved) < set(container["args"])
    log = tmp_path / "log"
    with log.open("w") as output:
        server = subprocess.Popen(
            [sys.executable, "-m", *container["command"], *arguments], stdout=output, stderr=output, cwd=tmp_path
        )
    try:
        deadline_s = time.monotonic() + 600
        while True:
            assert server.poll() is None and time.monotonic() < deadline_s, log.read_text()
            try:
                kubelet = answer(port, container["readinessProbe"]["httpGet"]["path"], "10.244.1.7:5000")
                break
            except urllib.error.URLError:
                time.sleep(0.5)
        assert kubelet == 200
        path = "/api/2.0/mlflow/experiments/get?experiment_id=0"
        assert answer(port, path, "shoal-mlflow:5000") == 200
        assert answer(port, path, "localhost:5000") == 200
        assert answer(port, path, "elsewhere.example:5000") == 403
    finally:
        server.terminate()
        server.wait()
    assert (tmp_path / "mlflow.db").is_file()
