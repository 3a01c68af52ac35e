"""Rows in zarr: readable with zarr alone, and damage is detected."""

import numpy as np
import pytest
import zarr

from actors.storage import zarr_columns
from actors.storage.zarr_columns import load_rows, save_rows

DTYPE = np.dtype([("reward", "f4"), ("action", "i4"), ("observation", "i1", (2, 3))], align=True)


def make_rows(count=50):
    rng = np.random.default_rng(0)
    rows = np.zeros(count, DTYPE)
    rows["reward"], rows["action"] = rng.normal(size=count), rng.integers(1, 9, count)
    rows["observation"] = rng.integers(1, 100, (count, 2, 3))
    return rows


def chunk_files(path):
    return sorted(file for file in path.rglob("c/**/*") if file.is_file())


@pytest.fixture
def saved(tmp_path, monkeypatch):
    """A group with several chunks per column."""
    monkeypatch.setattr(zarr_columns, "CHUNK_ROWS", 20)
    save_rows(tmp_path / "rows.zarr", make_rows())
    return tmp_path / "rows.zarr"


def assert_same(rows, expected):
    for name in DTYPE.names:
        np.testing.assert_array_equal(rows[name], expected[name], err_msg=name)


@pytest.mark.parametrize("count", [0, 1, 20, 50])
def test_round_trip(tmp_path, count):
    save_rows(tmp_path / "rows.zarr", make_rows(count))
    assert_same(load_rows(tmp_path / "rows.zarr", DTYPE), make_rows(count))


def test_zarr_alone_reads_the_columns(saved):
    root = zarr.open_group(str(saved), mode="r")
    assert sorted(root.array_keys()) == sorted(DTYPE.names)
    for name in DTYPE.names:
        np.testing.assert_array_equal(root[name][...], make_rows()[name], err_msg=name)
    assert root.attrs["rows"] == 50 and root.attrs["format"] == zarr_columns.FORMAT


def test_a_new_save_replaces_the_old(saved):
    save_rows(saved, make_rows(7))
    assert_same(load_rows(saved, DTYPE), make_rows(7))


def test_a_flipped_bit_in_any_chunk_is_detected(saved):
    files = chunk_files(saved)
    assert len(files) == 9  # three chunks in each of three columns
    for i, file in enumerate(files):
        whole = file.read_bytes()
        damaged = bytearray(whole)
        damaged[(7 * i) % (10 * DTYPE["action"].itemsize)] ^= 1 << (i % 8)
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match="damaged"):
            load_rows(saved, DTYPE)
        file.write_bytes(whole)
    assert_same(load_rows(saved, DTYPE), make_rows())


def test_a_missing_chunk_is_detected_although_zarr_reads_zeros(saved):
    for file in chunk_files(saved):
        whole = file.read_bytes()
        file.unlink()
        with pytest.raises(ValueError, match="damaged"):
            load_rows(saved, DTYPE)
        file.write_bytes(whole)


def test_a_truncated_chunk_is_detected(saved):
    file = chunk_files(saved)[0]
    file.write_bytes(file.read_bytes()[:-3])
    with pytest.raises(ValueError):
        load_rows(saved, DTYPE)


@pytest.mark.parametrize("name", ["zarr.json", "reward/zarr.json", "observation/zarr.json"])
def test_missing_metadata_is_detected(saved, name):
    (saved / name).unlink()
    with pytest.raises(ValueError):
        load_rows(saved, DTYPE)


@pytest.mark.parametrize(
    "other",
    [
        [("reward", "f8"), ("action", "i4"), ("observation", "i1", (2, 3))],
        [("reward", "f4"), ("action", "i4"), ("observation", "i1", (3, 2))],
        [("reward", "f4"), ("action", "i4"), ("observation", "i1", (6,))],
        [("reward", "f4"), ("action", "i4"), ("observation", "i1", (2, 3)), ("priority", "f4")],
    ],
)
def test_other_columns_are_refused(saved, other):
    with pytest.raises(ValueError):
        load_rows(saved, np.dtype(other))


def test_anything_but_saved_rows_is_refused(tmp_path):
    with pytest.raises(ValueError, match="incomplete"):
        load_rows(tmp_path / "nothing.zarr", DTYPE)
    zarr.open_group(str(tmp_path / "other.zarr"), mode="w")
    with pytest.raises(ValueError, match="format"):
        load_rows(tmp_path / "other.zarr", DTYPE)


def test_a_store_in_zarr_format_2_is_refused(tmp_path):
    """Format 2 allows the pickle codec, which runs code from the file."""
    root = zarr.open_group(str(tmp_path / "old.zarr"), mode="w", zarr_format=2)
    root.attrs.update({"format": zarr_columns.FORMAT, "rows": 0, "crc32": {}})
    with pytest.raises(ValueError, match="missing or incomplete"):
        load_rows(tmp_path / "old.zarr", DTYPE)


@pytest.mark.parametrize("rows", [10**15, -1, "50", 50.0, None, [50]])
def test_an_impossible_number_of_rows_is_refused_before_memory_is_allocated(saved, rows):
    zarr.open_group(str(saved), mode="r+").attrs["rows"] = rows
    with pytest.raises(ValueError, match="claims"):
        load_rows(saved, DTYPE)


def test_more_rows_than_accepted_are_refused(saved):
    load_rows(saved, DTYPE, at_most=50)
    with pytest.raises(ValueError, match="claims 50 rows; at most 49"):
        load_rows(saved, DTYPE, at_most=49)


def test_columns_longer_than_the_declared_rows_are_refused(tmp_path):
    root = zarr.open_group(str(tmp_path / "huge.zarr"), mode="w", zarr_format=3)
    root.create_array("reward", shape=(10**14,), dtype="f4", chunks=(10**9,))
    root.attrs.update({"format": zarr_columns.FORMAT, "rows": 5, "crc32": {"reward": 0}})
    with pytest.raises(ValueError, match=r"reward.*not float32\(5,\)"):
        load_rows(tmp_path / "huge.zarr", np.dtype([("reward", "f4")]))
