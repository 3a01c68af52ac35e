"""Bad input on the command line: exit code 2, a sentence that says what and how to mend it, no traceback."""

import contextlib
import dataclasses
import importlib
import json
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

import mlflow
import pytest
import torch

from actors.storage.fragment_writer import file_sum
from deploy.chaos.processes import free_port
from deploy.cli import main, parse
from learner.checkpoints.manifest import decode_manifest, encode_manifest
from learner.presets import preset_config
from learner.run_folder import RunFolder
from learner.tracking.mlflow_run import tracking_at
from tests.integration.conftest import SMALL, flags


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    try:
        code = main(arguments)
    except SystemExit as stop:  # tyro's way out
        code = stop.code if isinstance(stop.code, int) else 1
    return code, capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--robots", "0"], ["robots", "at least 2", "0"]),
        (["--robots", "five"], ["--robots", "five"]),
        (["--robts", "5"], ["--robts", "--robots"]),
        (["--groups", "-1"], ["groups", "at least 1"]),
        (["--inner-radius-m", "2"], ["inner_radius_m", "outer_radius_m", "smaller"]),
        (["--time-step-s", "-0.05"], ["time_step_s", "greater than 0"]),
        (["--time-step-s", "nan"], ["time_step_s", "finite"]),
        (["--robots", "400", "--groups", "8"], ["does not fit", "arena_radius_m"]),
        (["--start-spacing-m", "0.2"], ["overlap", "start_spacing_m"]),
        (["--engine", "slurm"], ["--engine", "process"]),
        (["--batch-size", "0"], ["batch_size", "at least 1"]),
        (["--replay", "prioritized"], ["--replay", "prioritised"]),
        (["--replay", "prioritised", "--priority-exponent", "2"], ["priority_exponent", "between 0 and 1"]),
        (["--target-update", "soft", "--target-update-rate", "0"], ["target_update_rate", "(0, 1]"]),
        (["--loss", "l1"], ["--loss", "huber", "mse"]),
        (["--discount", "1.5"], ["discount", "(0, 1]"]),
        (["--min-replay", "9999999"], ["min_replay", "replay_capacity"]),
        (["--env-id", "NoSuchEnv-v0"], ["env_id", "NoSuchEnv"]),
        (["--env-id", "Pendulum-v1"], ["env_id", "Discrete"]),
        (["--name", "../up"], ["--name", "plain folder name"]),
        (["--name", "greedy"], ["--name greedy", "a baseline", "choose another"]),
        (["--config", "missing.toml"], ["--config", "missing.toml", "cannot be read"]),
        (["--config", "missing.toml", "--preset", "best"], ["--config", "--preset", "leave one"]),
        (["--preset", "ours"], ["--preset", "thesis", "best"]),
        (["--runs-dir", "/proc/nothing"], ["--runs-dir", "write"]),
        (["--deadline-s", "0.5"], ["--deadline-s", "at least 1"]),
        (["--start-deadline-s", "0"], ["--start-deadline-s", "at least 1"]),
    ],
)
def test_train_refuses(capsys, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    code, error = run(capsys, "train", *arguments)
    assert code == 2
    assert "Traceback" not in error
    for word in words:
        assert word in error
    assert not list(tmp_path.iterdir()) or not list(tmp_path.glob("runs/*/config.json")), "nothing was started"


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
@pytest.mark.parametrize("engine", ["process", "ray"])
def test_cuda_is_refused_where_there_is_none(capsys, tmp_path, monkeypatch, engine):
    monkeypatch.chdir(tmp_path)
    code, error = run(capsys, "train", "--device", "cuda", "--engine", engine)
    assert code == 2 and "no CUDA device" in error and "--device auto" in error and "Traceback" not in error
    assert not list(tmp_path.glob("runs/*/config.json"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("learning_rat = 1e-3", ["unknown key", "learning_rat"]),
        ("[world]\nrobot = 5", ["unknown key", "robot", "[world]"]),
        ("batch_size = [", ["no valid TOML"]),
        ("batch_size = 1.5", ["batch_size", "whole number"]),
        ("[world]\nrobots = 'many'", ["robots", "whole number"]),
        ("world = 3", ["world", "section"]),
        ("learning_rate = 'fast'", ["learning_rate", "number"]),
        ("hidden_sizes = 64", ["hidden_sizes"]),
        ("hidden_sizes = " + "[" * 100_000, ["run.toml", "nested too deeply"]),
        ("world = " + "{a=" * 100_000, ["run.toml", "nested too deeply"]),
    ],
)
def test_train_refuses_a_config_file(capsys, tmp_path, monkeypatch, text, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.toml").write_text(text)
    code, error = run(capsys, "train", "--config", "run.toml")
    assert code == 2
    assert "Traceback" not in error
    for word in words:
        assert word in error


@pytest.mark.parametrize("method", ["sensor", "in", "out"])
def test_a_preset_gives_the_defaults_and_flags_override_them(method):
    command = parse(["train", "--preset", "thesis", "--method", method, "--robots", "7", "--n-step", "2"])
    expected = preset_config("thesis", method, 7, 2)
    assert command.run == dataclasses.replace(expected, n_step=2) and expected.n_step == 1
    assert parse(["train", "--preset=best"]).run == preset_config("best", "sensor")


def test_a_config_file_gives_the_defaults_and_flags_override_them(tmp_path):
    (tmp_path / "run.toml").write_text("batch_size = 64\nhidden_sizes = [32, 16]\n[world]\nrobots = 5\ngroups = 3\n")
    command = parse(["train", "--config", str(tmp_path / "run.toml"), "--robots", "7"])
    assert (command.run.batch_size, command.run.hidden_sizes) == (64, (32, 16))
    assert (command.run.world.robots, command.run.world.groups) == (7, 3)


def test_a_config_file_of_windows_begins_with_a_mark(tmp_path):
    (tmp_path / "run.toml").write_text("batch_size = 64\r\n", "utf-8-sig")
    assert parse(["train", "--config", str(tmp_path / "run.toml")]).run.batch_size == 64


def test_a_config_of_shoal_is_known_by_its_name_anywhere(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    named = parse(["train", "--config", "cartpole", "--seed", "3"]).run
    assert (named.env_id, named.hidden_sizes, named.seed) == ("CartPole-v1", (64, 64), 3)
    (tmp_path / "cartpole").mkdir()
    assert parse(["train", "--config", "cartpole", "--seed", "3"]).run == named
    code, error = run(capsys, "train", "--config", "cartpoll")
    assert code == 2 and "cartpoll cannot be read" in error and "configs of shoal: cartpole" in error
    (tmp_path / "own.toml").write_text("batch_size = 64\n")
    (tmp_path / "own.toml").rename(tmp_path / "cartpole" / "cartpole")
    monkeypatch.chdir(tmp_path / "cartpole")
    assert parse(["train", "--config", "cartpole"]).run.batch_size == 64  # a file of the user's goes first


def test_an_unreachable_tracking_server_is_refused_at_the_start(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    uri = f"http://127.0.0.1:{free_port()}"
    code, error = run(capsys, "train", "--tracking-uri", uri)
    assert code == 2
    assert uri in error
    assert "mlflow server" in error


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The runs folder of one small finished run named `r`; its name looks like rich's markup."""
    runs = tmp_path_factory.mktemp("cli") / "runs[/x]"
    assert main(["train", "--runs-dir", str(runs), "--name", "r", *flags(SMALL)]) == 0
    return runs


@pytest.fixture
def shared() -> Iterator[Path]:
    """A folder that other users reach, unlike pytest's own."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    yield folder
    shutil.rmtree(folder)


WHEN_NEEDED = ("deploy.runs.artifacts", "learner.export.policy_file", "learner.ray_backend.cluster")
"""Modules that functions import once they need them."""


@contextlib.contextmanager
def as_another_user(runs: Path, hidden: list[Path]) -> Iterator[None]:
    """Acts as a user who may read everything but `hidden`, and write nothing there; an administrator becomes nobody."""
    for name in ("deploy.commands.evaluate", "deploy.commands.resume", "deploy.commands.watch", *WHEN_NEEDED):
        importlib.import_module(name)  # nobody may not read the administrator's Python
    before = {path: path.stat().st_mode for path in [runs, *runs.rglob("*")]}
    for path, mode in reversed(before.items()):
        path.chmod(0 if path in hidden else mode & ~0o222 | 0o444)
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(user)
        for path, mode in before.items():
            path.chmod(mode)


@pytest.fixture
def runs(finished: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(finished, tmp_path / "runs"))


@pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy:DeprecationWarning")  # MLflow's own query
class TestWithARun:
    def test_a_taken_name_is_refused(self, capsys, runs):
        code, error = run(capsys, "train", "--runs-dir", str(runs), "--name", "r")
        assert code == 2
        assert "shoal resume r" in error

    def test_a_run_that_another_process_trains_is_refused(self, capsys, runs):
        with RunFolder(runs / "r").lock():
            code, error = run(capsys, "resume", "r", "--runs-dir", str(runs), "--total-env-steps", "9000")
        assert code == 2
        assert "another process is training" in error

    def test_an_unknown_run_is_refused(self, capsys, runs):
        for command in ("resume", "evaluate", "watch"):
            code, error = run(capsys, command, "nobody", "--runs-dir", str(runs))
            assert code == 2
            assert "nobody" in error
            assert "runs there: r" in error

    def test_a_finished_run_is_not_resumed_without_more_steps(self, capsys, runs):
        code, error = run(capsys, "resume", "r", "--runs-dir", str(runs))
        assert code == 2
        assert "--total-env-steps" in error

    def test_runs_go_on_where_they_were_moved(self, capsys, finished, tmp_path):
        """Copied and moved: the copy's store, artifacts and model are its own; the first ones stay as they are."""
        copy = Path(shutil.copytree(finished, tmp_path / "copy"))
        moved = copy.rename(tmp_path / "moved")
        before = (finished / "mlflow.db").read_bytes()
        assert run(capsys, "relocate", "--runs-dir", str(moved)) == (0, "")
        uri = f"sqlite:///{moved / 'mlflow.db'}"
        with tracking_at(uri):
            place = Path(mlflow.artifacts.download_artifacts("models:/sensor-3r-2g@best", dst_path=tmp_path / "model"))
        assert (place / "MLmodel").is_file()
        assert main(["resume", "r", "--runs-dir", str(moved), "--total-env-steps", "6500"]) == 0
        identity = RunFolder(moved / "r").identity()
        assert identity.tracking_uri == uri
        client = mlflow.MlflowClient(uri)
        assert client.get_run(identity.mlflow_run_id).info.artifact_uri.startswith(str(moved))
        assert client.get_run(identity.mlflow_run_id).data.params["total_env_steps"] == "6000"
        assert (finished / "mlflow.db").read_bytes() == before
        capsys.readouterr()
        assert run(capsys, "relocate", "--runs-dir", str(moved / "r"))[0] == 2

    def test_every_file_follows_the_umask(self, finished):
        mask = os.umask(0)
        os.umask(mask)
        wrong = [
            path
            for path in finished.rglob("*")
            if stat.S_IMODE(path.stat().st_mode) != (0o777 if path.is_dir() else 0o666) & ~mask
        ]
        assert not wrong

    @pytest.mark.parametrize(
        ("hidden", "command", "words"),
        [
            ("", ["resume", "--total-env-steps", "9000"], "may not be written to by you"),
            ("", ["watch"], "cannot be written to"),
            ("config.json", ["watch"], "config.json may not be read by you"),
            ("run.json", ["resume", "--total-env-steps", "9000"], "may not be"),
            ("checkpoints/*/learner.safetensors", ["watch", "--out"], "may not be read by you"),
            ("checkpoints/*", ["evaluate"], "may not be read by you"),
            ("checkpoints", ["evaluate"], "cannot be listed"),
            (".", ["evaluate"], "may not be used by you"),
        ],
    )
    def test_another_users_run_may_not_be_used(self, capsys, finished, hidden, command, words, shared):
        """Whoever may not read a file is told so, and not that it is damaged."""
        runs = Path(shutil.copytree(finished, shared / "runs"))
        name, *more = command
        out = [str(shared / "e.html")] if more == ["--out"] else []
        with as_another_user(runs, [*runs.glob(f"r/{hidden}")] if hidden else []):
            code, error = run(capsys, name, "r", "--runs-dir", str(runs), *more, *out)
        assert code == 2 and words in error
        assert "Traceback" not in error and "damaged" not in error and error.count("\n") == 1

    def test_another_user_watches_a_run_into_a_file_of_their_own(self, capsys, finished, shared):
        runs = Path(shutil.copytree(finished, shared / "runs"))
        (shared / "mine").mkdir()
        (shared / "mine").chmod(0o777)
        out = shared / "mine" / "e.html"
        assert main(["watch", "r", "--runs-dir", str(runs), "--out", str(out)]) == 0
        out.unlink()
        with as_another_user(runs, []):
            assert run(capsys, "watch", "r", "--runs-dir", str(runs), "--out", str(out)) == (0, "")
        assert [path.name for path in out.parent.iterdir()] == ["e.html"]

    @pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
    def test_a_run_of_another_device_is_resumed_elsewhere(self, capsys, runs):
        path = runs / "r" / "config.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"device": "cuda"}))
        further = ("resume", "r", "--runs-dir", str(runs), "--total-env-steps", "6500")
        code, error = run(capsys, *further)
        assert code == 2 and "no CUDA device" in error
        assert run(capsys, *further, "--device", "cpu")[0] == 0
        assert json.loads(path.read_text())["device"] == "cpu"

    def test_missing_checkpoints_are_refused(self, capsys, runs):
        shutil.rmtree(runs / "r" / "checkpoints")
        for command in (["resume", "--total-env-steps", "9000"], ["evaluate"], ["watch"]):
            code, error = run(capsys, *command, "r", "--runs-dir", str(runs))
            assert code == 2
            assert "no usable checkpoint" in error

    def test_damaged_checkpoints_are_refused_by_name(self, capsys, runs):
        for folder in (runs / "r" / "checkpoints").iterdir():
            path = folder / "learner.safetensors"
            data = bytearray(path.read_bytes())
            data[len(data) // 2] ^= 1
            path.write_bytes(data)
        code, error = run(capsys, "evaluate", "r", "--runs-dir", str(runs))
        assert code == 2
        assert "damaged (learner.safetensors: its content has another checksum)" in error

    def test_one_damaged_checkpoint_is_skipped_and_said(self, capsys, runs):
        newest = max((runs / "r" / "checkpoints").iterdir())
        (newest / "state.json").write_text("{}")
        assert main(["watch", "r", "--runs-dir", str(runs)]) == 0
        assert "skipped" in capsys.readouterr().err

    def test_a_checkpoint_of_another_config_is_refused(self, capsys, runs):
        path = runs / "r" / "config.json"
        config = json.loads(path.read_text())
        path.write_text(json.dumps(config | {"learning_rate": 0.5}))
        code, error = run(capsys, "resume", "r", "--runs-dir", str(runs), "--total-env-steps", "9000")
        assert code == 2
        assert "another config" in error

    @pytest.mark.parametrize(
        ("part", "value"),
        [
            ("pacing", {"inserted": "many"}),
            ("due", {}),
            ("workers", []),
            ("workers", [{}]),
            ("meters", {"sums": 5}),
            ("learner", {"shards": [{}], "rng": {}, "sizes": []}),
            ("learner", {"shards": [], "rng": None, "sizes": [1]}),
        ],
    )
    def test_a_state_that_means_harm_is_refused_though_its_checksums_are_right(self, capsys, runs, part, value):
        for folder in (runs / "r" / "checkpoints").iterdir():
            state = json.loads((folder / "state.json").read_text())
            (folder / "state.json").write_text(json.dumps(state | {part: value}))
            manifest = decode_manifest((folder / "manifest.json").read_bytes(), folder)
            files = {**manifest.files, "state.json": file_sum(folder / "state.json")}
            (folder / "manifest.json").write_bytes(encode_manifest(manifest.env_steps, files))
        code, error = run(capsys, "resume", "r", "--runs-dir", str(runs), "--total-env-steps", "9000")
        assert code == 2 and "does not fit this run" in error
        assert "Traceback" not in error and error.count("\n") == 1

    def test_a_policy_of_another_shape_is_refused(self, capsys, runs):
        path = runs / "r" / "config.json"
        config = json.loads(path.read_text())
        config["world"]["sectors"] = 12
        path.write_text(json.dumps(config))
        code, error = run(capsys, "watch", "r", "--runs-dir", str(runs))
        assert code == 2
        assert "sectors" in error

    def test_watch_makes_page_and_video(self, runs, tmp_path):
        page, video = tmp_path / "e.html", tmp_path / "e.mp4"
        assert main(["watch", "r", "--runs-dir", str(runs), "--out", str(page)]) == 0
        assert "<canvas" in page.read_text()
        assert main(["watch", "r", "--runs-dir", str(runs), "--format", "mp4", "--out", str(video)]) == 0
        assert video.read_bytes()[4:8] == b"ftyp"
        strip = tmp_path / "e.png"
        assert main(["watch", "r", "--runs-dir", str(runs), "--format", "png", "--out", str(strip)]) == 0
        assert strip.read_bytes().startswith(b"\x89PNG")
