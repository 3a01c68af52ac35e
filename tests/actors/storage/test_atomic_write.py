"""Atomic replacement: the old content or the new one, and nothing left beside it."""

import os

import pytest

from actors.storage.atomic_write import replace_folder, replacing_file, replacing_folder


class Crash(Exception):
    pass


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_file_is_replaced_once_it_is_whole(tmp_path):
    path = tmp_path / "a.json"
    path.write_text("old")
    with replacing_file(path) as partial:
        partial.write_text("new")
        assert path.read_text() == "old" and partial.parent == path.parent
    assert path.read_text() == "new" and names(tmp_path) == ["a.json"]


@pytest.mark.parametrize("error", [Crash, KeyboardInterrupt])
def test_a_failed_write_leaves_the_old_file_alone(tmp_path, error):
    path = tmp_path / "a.json"
    path.write_text("old")
    with pytest.raises(error), replacing_file(path) as partial:
        partial.write_text("half")
        raise error
    assert path.read_text() == "old" and names(tmp_path) == ["a.json"]


def test_a_failure_before_anything_was_written_is_the_one_that_comes_out(tmp_path):
    with pytest.raises(Crash), replacing_file(tmp_path / "a.json"):
        raise Crash
    assert names(tmp_path) == []


@pytest.mark.parametrize("sync_first", [False, True])
def test_content_is_synced_before_the_rename_where_asked(tmp_path, monkeypatch, sync_first):
    synced, real = [], os.fsync

    def watched(descriptor):
        synced.append((os.fstat(descriptor).st_size, (tmp_path / "a").exists()))
        real(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    with replacing_file(tmp_path / "a", sync_first=sync_first) as partial:
        partial.write_text("abc")
    assert synced == ([(3, False)] if sync_first else [])


def test_a_folder_replaces_an_older_one_and_what_a_crash_left(tmp_path):
    path = tmp_path / "a.zarr"
    for stale in (path, tmp_path / "a.zarr.part", tmp_path / "a.zarr.old"):
        stale.mkdir()
        (stale / "stale").touch()
    with replacing_folder(path) as partial:
        partial.mkdir()
        (partial / "new").touch()
        assert names(path) == ["stale"]
    assert names(path) == ["new"] and names(tmp_path) == ["a.zarr"]


def test_a_failed_folder_leaves_the_old_one_alone(tmp_path):
    path = tmp_path / "a.zarr"
    path.mkdir()
    (path / "old").touch()
    with pytest.raises(Crash), replacing_folder(path) as partial:
        partial.mkdir()
        (partial / "half").touch()
        raise Crash
    assert names(path) == ["old"] and names(tmp_path) == ["a.zarr"]


def test_the_new_name_of_a_folder_is_durable_before_the_old_one_goes(tmp_path, monkeypatch):
    new, path = tmp_path / "new", tmp_path / "a"
    new.mkdir()
    path.mkdir()
    seen, real = [], os.fsync

    def watched(descriptor):
        seen.append((os.fstat(descriptor).st_ino, names(tmp_path)))
        real(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    replace_folder(new, path)
    assert seen == [(tmp_path.stat().st_ino, ["a", "a.old"])] and names(tmp_path) == ["a"]
