"""A checkpoint is complete or does not exist, and a damaged one is never used."""

import json
import os
import random
import shutil
from pathlib import Path

import pytest

from actors.storage.fragment_writer import FragmentWriter, file_sum, join_results
from actors.storage.uri import join_location
from learner.checkpoints.checkpoint import (
    Retention,
    best_valid,
    commit_checkpoint,
    newest_valid,
    prune_checkpoints,
    read_checkpoint,
    valid_named,
)
from learner.checkpoints.manifest import CheckpointError, UnusableCheckpointError, encode_manifest
from learner.checkpoints.retention import Score
from learner.checkpoints.store import open_store

STATE = {"seed": 0, "nested": {"numbers": [1, 2.5, 2**70]}}


def save_fragments(draft, seed=0):
    """Fragments as components write them: a file, a folder, an empty file."""
    content = random.Random(seed)
    first, second = content.randbytes(700), content.randbytes(300)

    def rows(path):
        (path / "c").mkdir(parents=True)
        (path / "c" / "0").write_bytes(second)

    writes = {"a.bin": lambda path: path.write_bytes(first), "rows.zarr": rows, "empty.bin": Path.touch}
    results = []
    for name, write in writes.items():
        writer = FragmentWriter()
        writer.start(join_location(draft, name), write)
        results.append(writer.result(30.0))
    written = join_results(results)
    assert written.error is None
    return written.files


def write(root, env_steps, seed=0):
    store = open_store(root)
    draft = store.draft(env_steps)
    return commit_checkpoint(store, draft, env_steps, {**STATE, "seed": seed}, save_fragments(draft, seed))


def read(location):
    return read_checkpoint(open_store(location.parent), location.name)


def keep(root, newest, best=0, scores=()):
    store = open_store(root)
    prune_checkpoints(store, store.location(store.names()[0]), Retention(newest, best, list(scores)))


def files_of(folder):
    return sorted(path for path in folder.rglob("*") if path.is_file())


@pytest.fixture
def folder(tmp_path):
    return write(tmp_path, 1000, seed=4)


def test_round_trip(folder):
    checkpoint = read(folder)
    assert checkpoint.folder == folder and folder.name == "step-000000001000"
    assert checkpoint.state == {"seed": 4, "nested": {"numbers": [1, 2.5, 2**70]}}
    assert (folder / "a.bin").read_bytes() == random.Random(4).randbytes(700)
    assert len(files_of(folder)) == 5  # with state and manifest


def test_a_draft_that_is_never_committed_leaves_the_older_checkpoint(tmp_path, folder):
    for env_steps in (1000, 2000):
        store = open_store(tmp_path)
        save_fragments(store.draft(env_steps), seed=9)  # without a commit
        found, skipped = newest_valid(tmp_path)
        assert (found.folder, found.state["seed"], skipped) == (folder, 4, [])


def test_what_a_crash_leaves_is_no_checkpoint_and_is_removed(tmp_path, folder):
    crashed = tmp_path / "step-000000002000.part"
    shutil.copytree(folder, crashed)
    assert newest_valid(tmp_path)[0].folder == folder
    (crashed / "a.bin").write_bytes(b"of the crashed writer")
    (crashed / "stray").touch()
    (tmp_path / "step-of-mine.part").touch()
    assert len(files_of(write(tmp_path, 2000))) == 5
    shutil.copytree(folder, tmp_path / "step-000000003000.part")
    keep(tmp_path, 2)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "step-000000001000",
        "step-000000002000",
        "step-of-mine.part",
    ]


def test_the_rename_comes_after_every_file_and_folder_is_synced(tmp_path, monkeypatch):
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


def test_a_checkpoint_at_the_same_step_is_replaced(tmp_path, folder):
    assert write(tmp_path, 1000, seed=5) == folder
    assert read(folder).state["seed"] == 5
    assert [path.name for path in tmp_path.iterdir()] == ["step-000000001000"]


@pytest.mark.parametrize("renames", [0, 1])
def test_a_crash_while_replacing_leaves_the_older_checkpoint(tmp_path, folder, monkeypatch, renames):
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
    keep(tmp_path, 1)
    assert newest_valid(tmp_path)[0].state["seed"] == 4
    assert read(write(tmp_path, 1000, seed=6)).state["seed"] == 6
    keep(tmp_path, 1)
    assert [path.name for path in tmp_path.iterdir()] == ["step-000000001000"]


def test_a_flipped_bit_in_any_file_is_detected(folder):
    places = random.Random(0)
    data = [path for path in files_of(folder) if path.name != "manifest.json" and path.stat().st_size]
    for _ in range(80):
        path = places.choice(data)
        whole = path.read_bytes()
        damaged = bytearray(whole)
        damaged[places.randrange(len(whole))] ^= 1 << places.randrange(8)
        path.write_bytes(damaged)
        with pytest.raises(CheckpointError, match=path.name):
            read(folder)
        path.write_bytes(whole)
    read(folder)


def test_a_flipped_bit_in_the_manifest_is_detected(folder):
    path = folder / "manifest.json"
    whole = path.read_bytes()
    for place in range(len(whole)):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << place % 8
        path.write_bytes(damaged)
        with pytest.raises(UnusableCheckpointError):
            read(folder)


def test_every_truncated_or_missing_file_is_detected(folder):
    places = random.Random(1)
    for path in files_of(folder):
        whole = path.read_bytes()
        for length in {*places.choices(range(len(whole)), k=15), 0} if whole else set():
            path.write_bytes(whole[:length])
            with pytest.raises(CheckpointError):
                read(folder)
        path.unlink()
        with pytest.raises(CheckpointError):
            read(folder)
        path.write_bytes(whole)
    read(folder)


def test_a_sparse_file_of_terabytes_is_not_read(folder):
    os.truncate(folder / "a.bin", 2**42)
    with pytest.raises(CheckpointError, match="a.bin: 4398046511104 bytes, not 700"):
        read(folder)
    os.truncate(folder / "manifest.json", 2**42)
    with pytest.raises(CheckpointError, match="more than"):
        read(folder)


@pytest.mark.parametrize("what", ["file", "folder", "manifest"])
def test_links_are_refused_even_if_they_lead_to_the_right_content(folder, tmp_path, what):
    path = folder / {"file": "a.bin", "folder": "rows.zarr", "manifest": "manifest.json"}[what]
    path.rename(tmp_path / "elsewhere")
    path.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(CheckpointError, match="is a link"):
        read(folder)


def test_a_pipe_does_not_hang(folder):
    (folder / "a.bin").unlink()
    os.mkfifo(folder / "a.bin")
    with pytest.raises(CheckpointError, match="not a regular file"):
        read(folder)


def test_the_newest_that_passes_is_used_and_the_skipped_ones_are_named(tmp_path):
    folders = [write(tmp_path, env_steps) for env_steps in (999, 1_000, 20_000, 100_000)]
    (folders[3] / "a.bin").write_bytes(b"")
    (folders[2] / "manifest.json").unlink()
    found, skipped = newest_valid(tmp_path)
    assert found.folder == folders[1]
    assert len(skipped) == 2 and "100000" in skipped[0] and "a.bin" in skipped[0] and "20000" in skipped[1]


def test_no_usable_checkpoint_is_an_error_with_the_newest_reason(tmp_path):
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
    keep(tmp_path, 2)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes", "step-000000000020", "step-000000000100"]
    keep(tmp_path, 5)
    assert newest_valid(tmp_path)[0].folder.name == "step-000000000100"


def test_the_best_are_kept_and_found(tmp_path):
    folders = {env_steps: write(tmp_path, env_steps) for env_steps in (10, 20, 30, 40)}
    scores = [Score(10, 0.5), Score(20, 0.9), Score(30, 0.7), Score(40, 0.1)]
    keep(tmp_path, 1, 1, scores)
    assert {path.name for path in tmp_path.iterdir()} == {folders[20].name, folders[40].name}
    assert best_valid(tmp_path, scores)[0].folder == folders[20]
    (folders[20] / "a.bin").unlink()
    found, skipped = best_valid(tmp_path, scores)
    assert found.folder == folders[40] and "step-000000000020" in skipped[0]
    with pytest.raises(CheckpointError, match="from after an evaluation"):
        best_valid(tmp_path, [])
    assert valid_named(tmp_path, folders[40].name).folder == folders[40]
    with pytest.raises(CheckpointError, match=f"no checkpoint 'step-7'.*there are: .*{folders[40].name}"):
        valid_named(tmp_path, "step-7")


def test_skipped_checkpoints_are_removed_and_do_not_displace_good_ones(tmp_path):
    good, bad = write(tmp_path, 10), write(tmp_path, 30)
    (bad / "a.bin").unlink()
    new = write(tmp_path, 20)  # by a run that was resumed from 10
    store = open_store(tmp_path)
    prune_checkpoints(store, new, Retention(1, 0, []))
    assert newest_valid(tmp_path)[0].folder == new
    assert not good.exists() and not bad.exists()


@pytest.mark.parametrize(
    ("version", "error"), [(1, UnusableCheckpointError), (3, UnusableCheckpointError), (6, CheckpointError)]
)
def test_another_format_is_refused_by_name(folder, version, error):
    """Up to version 3, a manifest was one JSON object without a checksum of its own."""
    text = json.dumps({"format": f"shoal-checkpoint-{version}", "env_steps": 1, "sha256": {"state.json": "0" * 64}})
    (folder / "manifest.json").write_text(text)
    match = f"'shoal-checkpoint-{version}', this version reads 'shoal-checkpoint-5'"
    with pytest.raises(CheckpointError, match=match) as caught:
        read(folder)
    assert type(caught.value) is error


@pytest.mark.parametrize("content", [b"[]", b"7", b"\xff", b"[" * 100_000, b"null"])
def test_a_state_that_is_not_an_object_is_refused(tmp_path, content):
    store = open_store(tmp_path)
    draft = store.draft(5)
    files = save_fragments(draft)
    location = commit_checkpoint(store, draft, 5, {}, files)
    (location / "state.json").write_bytes(content)
    manifest = encode_manifest(5, {**files, "state.json": file_sum(location / "state.json")})
    (location / "manifest.json").write_bytes(manifest)
    with pytest.raises(CheckpointError, match="state.json is not a JSON object"):
        read(location)


def test_a_missing_folder_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match="No such file"):
        read(tmp_path / "step-000000000001")
