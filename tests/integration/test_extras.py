"""Without the packages of the extras a run trains to its end, and what needs one of them names the extra to install."""

import json
import subprocess
import sys

import pytest

from tests.integration.conftest import SMALL, clean_environment, flags

EXTRAS = {
    "dashboard": ("plotly",),
    "export": ("onnx", "onnxruntime", "onnxscript"),
    "s3": ("s3fs",),
    "video": ("imageio_ffmpeg", "pygame"),
}
SCRIPT = """
import contextlib, io, json, sys
packages, commands = json.loads(sys.argv[1])
sys.modules.update(dict.fromkeys(packages))  # as if they were not installed
from deploy.cli import main
found = []
for arguments in commands:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(arguments)
    found.append((code, out.getvalue(), err.getvalue()))
print(json.dumps(found))
"""
CARTPOLE = ["--env-id", "CartPole-v1", "--engine", "process", "--total-env-steps", "3000", "--min-replay", "500"]
CARTPOLE += ["--final-eval-episodes", "2", "--eval-episodes", "2"]


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """(exit code, stdout, stderr) of each command, by its name, where no package of an extra is installed."""
    commands = {
        "train": ["train", "--name", "swarm", *flags(SMALL)],
        "train cartpole": ["train", "--name", "cartpole", *CARTPOLE],
        "watch": ["watch", "swarm"],
        "watch png": ["watch", "swarm", "--format", "png"],
        "watch mp4": ["watch", "swarm", "--format", "mp4"],
        "watch cartpole": ["watch", "cartpole", "--format", "mp4"],
        "dashboard": ["dashboard", "swarm"],
        "export": ["export", "swarm"],
        "s3": ["train", "--name", "stored", "--checkpoint-url", "s3://bucket/path", *flags(SMALL)],
    }
    packages = [name for names in EXTRAS.values() for name in names]
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, json.dumps([packages, list(commands.values())])],
        cwd=tmp_path_factory.mktemp("extras"),
        env=clean_environment(),
        capture_output=True,
        text=True,
        check=True,
    )
    return dict(zip(commands, json.loads(done.stdout.splitlines()[-1]), strict=True))


@pytest.mark.parametrize("command", ["train", "watch", "watch png"])
def test_training_and_its_pictures_need_no_extra(found, command):
    code, out, err = found[command]
    assert (code, err) == (0, "")
    if command == "train":
        assert "episode.html" in out


def test_a_run_without_the_packages_for_videos_ends_without_an_animation(found):
    code, out, _ = found["train cartpole"]
    assert code == 0
    (line,) = [line for line in out.splitlines() if "pip install" in line]
    assert line.startswith("no animation: ") and "pip install 'shoal[video]'" in line
    assert [line.split() for line in out.splitlines() if line.startswith("animation")] == [["animation", "none"]]


@pytest.mark.parametrize(
    ("command", "extra"),
    [
        ("watch mp4", "video"),
        ("watch cartpole", "video"),
        ("dashboard", "dashboard"),
        ("export", "export"),
        ("s3", "s3"),
    ],
)
def test_what_needs_an_extra_names_it(found, command, extra):
    code, out, err = found[command]
    assert (code, out) == (2, "")
    assert err.startswith("shoal: ") and err.count("\n") == 1 and f"pip install 'shoal[{extra}]'" in err
