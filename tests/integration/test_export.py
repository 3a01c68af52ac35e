"""`shoal export` from a run, a checkpoint and a kept policy, and the example loop that runs with what it wrote."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from actors.rollout.vector_env import env_shape
from deploy.cli import main
from learner.checkpoints.checkpoint import newest_valid
from learner.export.policy_file import read_policy
from learner.export.saved_policy import save_policy
from learner.run_folder import RunFolder
from tests.integration.conftest import SMALL, flags

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy:DeprecationWarning"),  # MLflow's own query
]
EXAMPLE = Path(__file__).parents[2] / "deploy" / "examples" / "robot_loop.py"
ONLY_ITS_OWN = """
import runpy, sys
path, folder = sys.argv[1:]
sys.argv = [path, folder]
runpy.run_path(path, run_name="__main__")
loaded = {"torch", "sim_core", "actors", "learner", "deploy", "ray", "numba"} & set(sys.modules)
assert not loaded, loaded
"""


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of one small finished run."""
    runs = tmp_path_factory.mktemp("export") / "runs"
    assert main(["train", "--runs-dir", str(runs), "--name", "r", *flags(SMALL)]) == 0
    return runs / "r"


def export(*arguments: str) -> int:
    return main(["export", *arguments, "--states", "200"])


@pytest.fixture(scope="module")
def exported(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of its export."""
    folder = tmp_path_factory.mktemp("exported") / "e"
    assert export(str(finished), "--out", str(folder)) == 0
    return folder


def golden_states(folder):
    """Arrays by name of an export's golden states."""
    with np.load(folder / "golden.npz") as file:
        return dict(file)


def test_a_run_its_checkpoint_and_a_kept_policy_are_the_same_export(finished, exported, tmp_path, capsys):
    folder = RunFolder(finished)
    config = folder.config()
    checkpoint, _ = newest_valid(folder.checkpoints)
    save_policy(folder.policy, read_policy(checkpoint, config, env_shape(config.env)))
    expected = golden_states(exported)
    for name, source in {"checkpoint": checkpoint.folder, "policy": folder.policy}.items():
        assert export(str(source), "--out", str(tmp_path / name)) == 0
        found = golden_states(tmp_path / name)
        for key in expected:
            np.testing.assert_array_equal(found[key], expected[key])
    assert "decided" in capsys.readouterr().out
    about = json.loads((exported / "policy.json").read_text())
    assert (about["method"], about["setup"], about["updates"]) == ("sensor", "3r×2g", checkpoint.state["updates"])
    assert about["settings"]["world"]["robots"] == 3
    assert about["checked"]["policy.onnx"]["states"] == 200


def test_the_example_runs_on_numpy_and_onnxruntime_alone(exported, tmp_path):
    command = [sys.executable, "-I", "-W", "error", "-c", ONLY_ITS_OWN, str(EXAMPLE), str(exported)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 13 and lines[-1].endswith("us a tick")
    velocities = [np.array(line.split("[")[1].split("]")[0].split(), float) for line in lines[:-1]]
    np.testing.assert_allclose(np.linalg.norm(velocities, axis=1), 1.0, atol=0.02)
    assert len(EXAMPLE.read_text().splitlines()) <= 79


def test_the_example_drives_with_a_shield_where_the_policy_does(exported, tmp_path):
    shutil.copytree(exported, tmp_path / "e")
    about = json.loads((tmp_path / "e" / "policy.json").read_text())
    assert about["shield"]["used"] is False and about["shield"]["top_speed_m_s"] == 1.0
    about["shield"]["used"] = True
    (tmp_path / "e" / "policy.json").write_text(json.dumps(about))
    driven = []
    for folder in (exported, tmp_path / "e"):
        command = [sys.executable, "-I", "-W", "error", str(EXAMPLE), str(folder)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        driven.append(done.stdout.splitlines()[:-1])
    assert driven[0] != driven[1], "the robot meets robots that its policy runs into"


def test_the_example_refuses_an_export_that_answers_otherwise(exported, tmp_path):
    shutil.copytree(exported, tmp_path / "e")
    golden = golden_states(exported)
    golden["out.action_values"] += 0.1
    np.savez(tmp_path / "e" / "golden.npz", **golden)
    command = [sys.executable, "-I", str(EXAMPLE), str(tmp_path / "e")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "does not answer as it should" in done.stderr


@pytest.mark.parametrize(
    ("env", "size"), [(["--env-id", "CartPole-v1"], 4), (["--robots", "3", "--sector-frame", "goal"], 16)]
)
def test_what_a_robot_cannot_sense_by_itself_is_exported_bare(env, size, tmp_path, capsys):
    small = ["--total-env-steps", "3000", "--min-replay", "500", "--final-eval-episodes", "4", "--eval-episodes", "2"]
    runs = ["--runs-dir", str(tmp_path / "runs")]
    assert main(["train", *runs, "--name", "c", *env, "--engine", "process", *small]) == 0
    assert export("c", *runs) == 2
    assert "--bare True" in capsys.readouterr().err
    assert export("c", *runs, "--bare", "True") == 0
    about = json.loads((tmp_path / "runs/c/artifacts/export-bare/policy.json").read_text())
    assert [port["name"] for port in about["inputs"]] == ["observation"]
    assert about["inputs"][0]["shape"] == ["batch", size]
    assert "method" not in about


def test_bad_input_is_refused_in_one_sentence(finished, tmp_path, capsys):
    for arguments, words in (
        (["nobody"], "there is no run"),
        ([str(tmp_path / "policy.safetensors")], "there is no run"),
        ([str(finished), "--out", str(finished)], "holds other things"),
        ([str(finished / "config.json"), "--out", str(tmp_path / "e")], "cannot be read"),
    ):
        assert export(*arguments) == 2
        error = capsys.readouterr().err
        assert words in error and "Traceback" not in error
    assert main(["export", str(finished), "--states", "0"]) == 2
    assert "--states" in capsys.readouterr().err
