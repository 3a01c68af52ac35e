"""Checkpoints: whole or not there, and never read back damaged."""

import json
import os
import random
import shutil
from pathlib import Path

import pytest

from learner.checkpoint import CheckpointError, keep_newest, newest_valid, read_checkpoint, write_checkpoint


def save_parts(folder, seed=0):
    """Some files, one in a folder, one empty."""
    content = random.Random(seed)
    (folder / "a.bin").write_bytes(content.randbytes(700))
    (folder / "rows.zarr" / "c").mkdir(parents=True)
    (folder / "rows.zarr" / "c" / "0").write_bytes(content.randbytes(300))
    (folder / "empty.bin").touch()
    return {"seed": seed, "nested": {"numbers": [1, 2.5, 2**70]}}


def write(root, env_steps, seed=0):
    return write_checkpoint(root, env_steps, lambda folder: save_parts(folder, seed))


def files_of(folder):
    return sorted(path for path in folder.rglob("*") if path.is_file())


@pytest.fixture
def folder(tmp_path):
    return write(tmp_path, 1000, seed=4)


def test_round_trip(folder):
    checkpoint = read_checkpoint(folder)
    assert checkpoint.folder == folder and folder.name == "step-000000001000"
    assert checkpoint.state == {"seed": 4, "nested": {"numbers": [1, 2.5, 2**70]}}
    assert (folder / "a.bin").read_bytes() == random.Random(4).randbytes(700)
    assert len(files_of(folder)) == 5  # with state and manifest


def test_a_failed_save_leaves_the_older_one(tmp_path, folder):
    def fail(part):
        save_parts(part)
        raise OSError("disk full")

    for env_steps in (1000, 2000):
        with pytest.raises(OSError, match="disk full"):
            write_checkpoint(tmp_path, env_steps, fail)
        found, skipped = newest_valid(tmp_path)
        assert (found.folder, found.state["seed"], skipped) == (folder, 4, [])


def test_the_leavings_of_a_crash_are_no_checkpoint(tmp_path, folder):
    crashed = tmp_path / "step-000000002000.part"
    shutil.copytree(folder, crashed)
    assert newest_valid(tmp_path)[0].folder == folder
    (crashed / "a.bin").write_bytes(b"of the crashed one")
    (crashed / "stray").touch()
    assert len(files_of(write(tmp_path, 2000))) == 5
    shutil.copytree(folder, tmp_path / "step-000000003000.part")
    keep_newest(tmp_path, 2)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["step-000000001000", "step-000000002000"]


def test_the_folder_gets_its_name_after_everything_is_there_and_synced(tmp_path, monkeypatch):
    moments, real = [], os.fsync
    final = tmp_path / "step-000000000007"

    def watched(descriptor):
        moments.append((os.fstat(descriptor).st_ino, final.exists()))
        real(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    write(tmp_path, 7)
    inodes = {path.stat().st_ino for path in [*files_of(final), final, final / "rows.zarr", final / "rows.zarr" / "c"]}
    assert inodes <= {inode for inode, named in moments if not named}
    assert moments[-1] == (tmp_path.stat().st_ino, True)


def test_the_same_step_is_replaced(tmp_path, folder):
    assert write(tmp_path, 1000, seed=5) == folder
    assert read_checkpoint(folder).state["seed"] == 5
    assert [path.name for path in tmp_path.iterdir()] == ["step-000000001000"]


@pytest.mark.parametrize("renames", [0, 1])
def test_a_crash_while_replacing_leaves_one_of_the_two(tmp_path, folder, monkeypatch, renames):
    real, done = Path.rename, []

    def crashing(path, target):
        if len(done) == renames:
            raise OSError("power cut")
        done.append(path)
        return real(path, target)

    monkeypatch.setattr(Path, "rename", crashing)
    with pytest.raises(OSError, match="power cut"):
        write(tmp_path, 1000, seed=5)
    monkeypatch.undo()
    assert newest_valid(tmp_path)[0].state["seed"] == 4
    keep_newest(tmp_path, 1)
    assert newest_valid(tmp_path)[0].state["seed"] == 4
    assert read_checkpoint(write(tmp_path, 1000, seed=6)).state["seed"] == 6
    keep_newest(tmp_path, 1)
    assert [path.name for path in tmp_path.iterdir()] == ["step-000000001000"]


def test_a_flipped_bit_anywhere_is_noticed(folder):
    places = random.Random(0)
    data = [path for path in files_of(folder) if path.name != "manifest.json" and path.stat().st_size]
    for _ in range(80):
        path = places.choice(data)
        whole = path.read_bytes()
        damaged = bytearray(whole)
        damaged[places.randrange(len(whole))] ^= 1 << places.randrange(8)
        path.write_bytes(damaged)
        with pytest.raises(CheckpointError, match=path.name):
            read_checkpoint(folder)
        path.write_bytes(whole)
    read_checkpoint(folder)


def test_a_flipped_bit_in_the_manifest_is_noticed_or_harmless(folder):
    """Nothing but a number for people and JSON's blanks may change; no other error comes out."""
    expected, refused = read_checkpoint(folder).state, 0
    path = folder / "manifest.json"
    whole = path.read_bytes()
    for place in range(len(whole)):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << (place % 7)
        path.write_bytes(damaged)
        try:
            assert read_checkpoint(folder).state == expected
            assert json.loads(damaged)["sha256"] == json.loads(whole)["sha256"]
        except CheckpointError:
            refused += 1
    assert refused > 0.95 * len(whole)


def test_every_cut_or_missing_file_is_noticed(folder):
    places = random.Random(1)
    for path in files_of(folder):
        whole = path.read_bytes()
        for length in {*places.choices(range(len(whole)), k=15), 0} if whole else set():
            path.write_bytes(whole[:length])
            with pytest.raises(CheckpointError):
                read_checkpoint(folder)
        path.unlink()
        with pytest.raises(CheckpointError):
            read_checkpoint(folder)
        path.write_bytes(whole)
    read_checkpoint(folder)


@pytest.mark.parametrize("sums", [{}, [], None, "x", {"state.json": 5}, {"../outside": "0"}])
def test_a_manifest_that_vouches_for_nothing_is_refused(folder, sums):
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps(manifest | {"sha256": sums}))
    with pytest.raises(CheckpointError):
        read_checkpoint(folder)


def test_the_newest_that_passes_is_taken_and_the_others_are_named(tmp_path):
    folders = [write(tmp_path, env_steps) for env_steps in (999, 1_000, 20_000, 100_000)]
    (folders[3] / "a.bin").write_bytes(b"")
    (folders[2] / "manifest.json").unlink()
    found, skipped = newest_valid(tmp_path)
    assert found.folder == folders[1]
    assert len(skipped) == 2 and "100000" in skipped[0] and "a.bin" in skipped[0] and "20000" in skipped[1]


def test_none_that_passes_is_an_error_with_the_newest_reason(tmp_path):
    with pytest.raises(CheckpointError, match="no usable checkpoint"):
        newest_valid(tmp_path / "missing")
    for env_steps in (1, 2):
        (write(tmp_path, env_steps) / "empty.bin").unlink()
    with pytest.raises(CheckpointError, match=r"step-000000000002.*empty\.bin"):
        newest_valid(tmp_path)


def test_the_newest_are_kept(tmp_path):
    for env_steps in (5, 100, 20, 3):
        write(tmp_path, env_steps)
    (tmp_path / "notes").mkdir()
    keep_newest(tmp_path, 2)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes", "step-000000000020", "step-000000000100"]
    keep_newest(tmp_path, 5)
    assert newest_valid(tmp_path)[0].folder.name == "step-000000000100"


@pytest.mark.parametrize("found", ["shoal-checkpoint-1", "shoal-checkpoint-2", None])
def test_another_format_is_refused(folder, found):
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps(manifest | {"format": found}))
    with pytest.raises(CheckpointError, match="shoal-checkpoint-3"):
        read_checkpoint(folder)


def test_a_missing_folder_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match="no checkpoint"):
        read_checkpoint(tmp_path / "step-000000000001")
