"""The cluster file of `ray up`, read by Ray itself."""

import copy
import re
import shlex

import click
import jsonschema
import pytest
from ray.autoscaler._private.util import prepare_config, validate_config
from ray.scripts.scripts import start as ray_start

from learner.ray_backend.cluster import LOCAL_RAY
from tests.deploy.manifests import ROOT, read_yaml, with_misspelt
from tests.deploy.project import CONTAINERFILE, image_ray_version

(CONFIG,) = read_yaml(ROOT / "deploy" / "ray-cluster.yml")


def check(config):
    """The checks of `ray up` before it connects to a machine."""
    prepared = prepare_config(copy.deepcopy(config))
    validate_config(prepared)
    return prepared


def test_ray_accepts_the_cluster_file():
    prepared = check(CONFIG)
    (kind,) = prepared["available_node_types"].values()
    assert kind["min_workers"] == kind["max_workers"] == len(CONFIG["provider"]["worker_ips"]) == 2
    for name in ("head_start_ray_commands", "worker_start_ray_commands"):
        assert prepared[name] == CONFIG[name], "ours, not the defaults"


@pytest.mark.parametrize(
    ("path", "wrong"),
    [
        (("setup_commands",), "set_up_commands"),
        (("head_start_ray_commands",), "head_start_commands"),
        (("auth", "ssh_private_key"), "ssh_key"),
    ],
)
def test_a_misspelt_field_is_found(path, wrong):
    with pytest.raises(jsonschema.ValidationError, match=wrong):
        check(with_misspelt(CONFIG, path, wrong))


def test_a_misspelt_address_is_found():
    with pytest.raises(click.ClickException, match="head_ip"):
        check(with_misspelt(CONFIG, ("provider", "head_ip"), "head_ips"))


@pytest.mark.parametrize("name", ["head_start_ray_commands", "worker_start_ray_commands"])
def test_ray_start_knows_every_flag_and_requires_the_token(name):
    (command,) = [text for text in CONFIG[name] if " start " in text]
    _, found, arguments = command.partition("~/venv/bin/ray start ")
    assert found and "RAY_AUTH_MODE=token" in command
    ray_start.make_context("start", shlex.split(arguments))  # click refuses unknown flags
    assert "--metrics-export-port=8080" in arguments


@pytest.mark.parametrize("name", ["head_start_ray_commands", "worker_start_ray_commands"])
def test_nodes_have_the_images_settings_of_ray(name):
    settings = re.findall(r"RAY_([a-z_]+)=(\d+)", CONTAINERFILE.read_text("utf-8"))
    assert len(settings) == 2
    assert settings == re.findall(r"RAY_([a-z_]+)=(\d+)", " ".join(CONFIG[name]))
    assert {setting for setting, _ in settings} <= set(LOCAL_RAY), "names that Ray is known to take"


def test_workers_join_the_heads_port():
    head, worker = (" ".join(CONFIG[name]) for name in ("head_start_ray_commands", "worker_start_ray_commands"))
    (port,) = re.findall(r"--port=(\d+)", head)
    assert f"--address=$RAY_HEAD_IP:{port}" in worker


def test_nodes_get_the_token_and_the_images_ray_version():
    assert CONFIG["file_mounts"]["~/.ray/auth_token"] == "~/.ray/auth_token"
    (install,) = [text for text in CONFIG["setup_commands"] if "pip install" in text]
    assert f"ray[default,tune]=={image_ray_version()}" in install
    (project,) = [target for target, source in CONFIG["file_mounts"].items() if source == "."]
    assert install.endswith(project)
