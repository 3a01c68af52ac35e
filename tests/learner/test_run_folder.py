"""A run's folder: its files, its lock, and finding it by name."""

import subprocess
import sys

import pytest

from learner.run_folder import RunFolder, RunIdentity, Storage, find_run
from sim_core.checks import ConfigError

IDENTITY = RunIdentity("ten robots", "sqlite:///mlflow.db", "shoal", "0123abc")


def test_config_round_trip(tmp_path, small_run):
    folder = RunFolder(tmp_path / "runs" / "one")
    folder.save_config(small_run)
    assert folder.config() == small_run
    assert sorted(path.name for path in folder.path.iterdir()) == ["config.json"]


def test_a_config_that_an_editor_of_windows_saved_is_read(tmp_path, small_run):
    folder = RunFolder(tmp_path)
    folder.save_config(small_run)
    path = tmp_path / "config.json"
    path.write_text(path.read_text(), "utf-8-sig")
    assert folder.config() == small_run


@pytest.mark.parametrize("place", ["runs/checkpoints/one", "runs/one/own", "elsewhere/one"])
def test_checkpoints_beside_a_run_move_with_it(tmp_path, place):
    folder = RunFolder(tmp_path / "runs" / "one")
    folder.save_storage(Storage(str(tmp_path / place), 1))
    assert folder.checkpoint_location() == tmp_path / place
    (tmp_path / "runs").rename(tmp_path / "moved")
    now = tmp_path / place.replace("runs", "moved")
    assert RunFolder(tmp_path / "moved" / "one").checkpoint_location() == now


def test_checkpoints_in_an_object_store_stay_there(tmp_path):
    folder = RunFolder(tmp_path / "one")
    folder.save_storage(Storage("memory://bucket/one", 0))
    assert folder.checkpoint_location() == "memory://bucket/one"


def test_what_a_refused_start_leaves_does_not_take_a_name(tmp_path):
    folder = RunFolder(tmp_path / "one")
    assert not folder.is_taken()
    with folder.lock():
        assert not folder.is_taken()
    (folder.path / "note.txt").touch()
    assert folder.is_taken()
    assert RunFolder(folder.path / "note.txt").is_taken()


def test_identity_round_trip(tmp_path):
    folder = RunFolder(tmp_path / "one")
    folder.save_identity(IDENTITY)
    folder.save_identity(IDENTITY._replace(mlflow_run_id="new"))
    assert folder.identity() == IDENTITY._replace(mlflow_run_id="new")


def test_paths_do_not_depend_on_the_working_directory(tmp_path, monkeypatch, small_run):
    monkeypatch.chdir(tmp_path)
    folder = RunFolder(find_path := (tmp_path / "one").relative_to(tmp_path))
    folder.save_config(small_run)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert not find_path.exists() and folder.config() == small_run
    for path in (folder.checkpoints, folder.journal, folder.pushed, folder.artifacts):
        assert path.parent == tmp_path / "one"


@pytest.mark.parametrize(
    "text", ["", "{", "[1, 2]", "7", '{"nonsense": 1}', '{"world": 5}', b"\xff\xfe", "[" * 100_000]
)
def test_a_damaged_config_is_refused(tmp_path, text):
    (tmp_path / "config.json").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigError):
        RunFolder(tmp_path).config()


@pytest.mark.parametrize("text", ["", "{}", '{"name": "x"}', '{"a": 1}', "[]"])
def test_a_damaged_identity_is_refused(tmp_path, text):
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(ConfigError, match="run.json"):
        RunFolder(tmp_path).identity()


def test_missing_files_are_refused_with_their_path(tmp_path):
    with pytest.raises(ConfigError, match="config.json"):
        RunFolder(tmp_path).config()
    with pytest.raises(ConfigError, match="run.json"):
        RunFolder(tmp_path).identity()


def test_runs_are_found_by_name_and_by_path(tmp_path, small_run):
    runs = tmp_path / "runs"
    for name in ("a", "b"):
        RunFolder(runs / name).save_config(small_run)
    assert find_run("b", runs).path == runs / "b"
    assert find_run(str(runs / "a"), tmp_path / "elsewhere").path == runs / "a"


def test_an_unknown_run_is_refused_with_a_list_of_runs(tmp_path, small_run):
    with pytest.raises(ConfigError, match="there are no runs in"):
        find_run("a", tmp_path)
    (tmp_path / "empty").mkdir()
    for i in range(7):
        RunFolder(tmp_path / f"run-{i}").save_config(small_run)
    with pytest.raises(ConfigError, match="run-2, run-3, run-4, run-5, run-6$"):
        find_run("empty", tmp_path)


def test_a_run_is_locked_by_one_process_at_a_time(tmp_path):
    path = tmp_path / "one"
    other = "import sys, pathlib, learner.run_folder as r\nwith r.RunFolder(pathlib.Path(sys.argv[1])).lock(): pass"
    with RunFolder(path).lock():
        with pytest.raises(ConfigError, match="another process is training .*one"):
            RunFolder(path).lock().__enter__()
        done = subprocess.run([sys.executable, "-c", other, str(path)], capture_output=True, text=True, check=False)
        assert done.returncode != 0 and "another process is training" in done.stderr
    done = subprocess.run([sys.executable, "-c", other, str(path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
