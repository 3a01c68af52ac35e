"""Kubernetes manifests and their schemas, for the tests of this folder."""

import copy
import os
import shutil
from functools import cache
from pathlib import Path

import kubernetes_validate
import yaml
from jsonschema import Draft202012Validator

ROOT = Path(__file__).parents[2]
KUBERNETES = ROOT / "deploy" / "kubernetes"
PROMETHEUS = ROOT / "deploy" / "prometheus"
CRDS = Path(os.environ.get("SHOAL_KUBERAY_CRDS") or ROOT.parent / "shared" / "data" / "kuberay")
"""Folder of KubeRay's rayclusters.crd.yaml and rayjobs.crd.yaml, v1.7.0, from KubeRay's release."""
RAY_KINDS = {"RayCluster": "rayclusters.crd.yaml", "RayJob": "rayjobs.crd.yaml"}
CORE_VERSION = "1.33"
PROMTOOL = shutil.which("promtool")


class OnlyOnce(yaml.SafeLoader):
    """A YAML loader that refuses duplicate keys."""


def _mapping(loader, node):
    keys = [loader.construct_object(key) for key, _ in node.value]
    assert len(keys) == len(set(keys)), f"a duplicate key {node.start_mark}"
    return loader.construct_mapping(node, deep=True)


OnlyOnce.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _mapping)


def read_yaml(path: Path):
    """All documents of a file."""
    return list(yaml.load_all(path.read_text("utf-8"), OnlyOnce))


def documents():
    """Every manifest, named KIND/NAME."""
    found = [document for path in sorted(KUBERNETES.glob("*.yml")) for document in read_yaml(path)]
    named = {f"{document['kind']}/{document['metadata']['name']}": document for document in found}
    assert len(named) == len(found), "two objects of one kind have one name"
    return named


def cluster_spec(document):
    """The cluster of a RayCluster or RayJob."""
    return document["spec"].get("rayClusterSpec", document["spec"])


def pod_templates(document):
    """The templates of a manifest's pods."""
    if document["kind"] in RAY_KINDS:
        spec = cluster_spec(document)
        return [group["template"] for group in (spec["headGroupSpec"], *spec["workerGroupSpecs"])]
    return [document["spec"]["template"]] if document["kind"] == "Deployment" else []


def check_core(document) -> None:
    """Raises kubernetes_validate.ValidationError if a field of `document` is not in Kubernetes' schema."""
    kubernetes_validate.validate(document, CORE_VERSION, strict=True)


def check_pods(document) -> None:
    """Applies `check_core` to the pods of a manifest."""
    for template in pod_templates(document):
        metadata = {**template["metadata"], "name": "pod"}
        check_core({"apiVersion": "v1", "kind": "Pod", "metadata": metadata, "spec": template["spec"]})


def _strict(schema) -> None:
    """Makes a structural schema refuse unknown fields, as `kubectl --validate=strict` does."""
    if schema.get("x-kubernetes-int-or-string"):
        schema.pop("type", None)
        schema["anyOf"] = [{"type": "integer"}, {"type": "string"}]
    if "properties" in schema and not schema.get("x-kubernetes-preserve-unknown-fields"):
        schema.setdefault("additionalProperties", False)
    inner = [*schema.get("properties", {}).values(), schema.get("items"), schema.get("additionalProperties")]
    for part in inner:
        if isinstance(part, dict):
            _strict(part)


@cache
def _validator(kind: str) -> Draft202012Validator:
    crd = yaml.load((CRDS / RAY_KINDS[kind]).read_text("utf-8"), yaml.CSafeLoader)
    (version,) = [version for version in crd["spec"]["versions"] if version["name"] == "v1"]
    schema = copy.deepcopy(version["schema"]["openAPIV3Schema"])
    assert schema["properties"]["spec"]["properties"].keys() > {"rayClusterSpec" if kind == "RayJob" else "rayVersion"}
    _strict(schema)
    return Draft202012Validator(schema)


def crd_errors(document) -> list[str]:
    """Errors of a document against KubeRay's definition of its kind."""
    return [f"{error.json_path}: {error.message}" for error in _validator(document["kind"]).iter_errors(document)]


def with_misspelt(document, path, wrong: str):
    """A copy in which the field at the end of `path`, keys and indices, is called `wrong`."""
    changed = copy.deepcopy(document)
    *parents, last = path
    parent = changed
    for step in parents:
        parent = parent[step]
    parent[wrong] = parent.pop(last)
    return changed
