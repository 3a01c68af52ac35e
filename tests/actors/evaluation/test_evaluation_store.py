"""Stored evaluations: round trip, readable with zarr alone, and damage is detected."""

import json

import numpy as np
import pytest
import zarr

from actors.evaluation import evaluation_store
from actors.evaluation.evaluation_store import StoredEvaluation, load_evaluation, save_evaluation
from actors.rollout.env_spec import EnvSpec
from actors.service.messages import EpisodeStats
from actors.storage import zarr_columns
from sim_core import ENV_ID
from sim_core.checks import ConfigError
from sim_core.config import WorldConfig

COLUMNS = ["episode_return", "length_steps", "outcome", "seed"]


def make_evaluation(episodes=50, seed=0):
    rng = np.random.default_rng(seed)
    return StoredEvaluation(
        spec=EnvSpec(ENV_ID, WorldConfig(robots=3, groups=4, method="out", apf_gain_m4_s=0.1 + 0.2)),
        candidate="a run ×",
        updates=123_456,
        seed=2_000_000_000 + np.arange(episodes),
        stats=EpisodeStats(
            rng.integers(1, 6, episodes).astype(np.int8),
            rng.integers(1, 500, episodes).astype(np.int32),
            rng.normal(size=episodes),
        ),
    )


@pytest.fixture
def path(tmp_path):
    return tmp_path / "e.zarr"


@pytest.fixture
def saved(path, monkeypatch):
    """A stored evaluation with several chunks per column."""
    monkeypatch.setattr(zarr_columns, "CHUNK_ROWS", 20)
    save_evaluation(path, make_evaluation())
    return path


def assert_same(first, second):
    assert first[:3] == second[:3]
    for a, b in zip((first.seed, *first.stats), (second.seed, *second.stats), strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.dtype == b.dtype


def chunk_files(path):
    return sorted(file for file in path.rglob("c/**/*") if file.is_file())


@pytest.mark.parametrize("episodes", [1, 20, 50])
def test_round_trip(path, episodes):
    save_evaluation(path, make_evaluation(episodes))
    assert_same(load_evaluation(path), make_evaluation(episodes))
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_zarr_alone_reads_the_columns(saved):
    root = zarr.open_group(str(saved), mode="r")
    assert sorted(root.array_keys()) == COLUMNS
    np.testing.assert_array_equal(root["seed"][...], make_evaluation().seed)
    np.testing.assert_array_equal(root["outcome"][...], make_evaluation().stats.outcome)
    assert root.attrs["format"] == evaluation_store.FORMAT
    assert root.attrs["header"]["world"]["groups"] == 4


def test_an_existing_evaluation_is_not_overwritten(saved):
    with pytest.raises(ConfigError, match=r"e\.zarr exists and is not overwritten"):
        save_evaluation(saved, make_evaluation(7, seed=1))
    assert_same(load_evaluation(saved), make_evaluation())


def test_the_remains_of_a_killed_save_are_no_evaluation_and_do_not_block_the_next_save(path, monkeypatch):
    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(evaluation_store, "_crc32", killed)
        with pytest.raises(KeyboardInterrupt):
            save_evaluation(path, make_evaluation(7, seed=1))
    with pytest.raises(ValueError, match="missing"):
        load_evaluation(path)
    save_evaluation(path, make_evaluation())
    assert_same(load_evaluation(path), make_evaluation())


def test_a_flipped_bit_in_any_chunk_is_detected(saved):
    files = chunk_files(saved)
    assert len(files) == 12  # three chunks in each of four columns
    for i, file in enumerate(files):
        whole = file.read_bytes()
        damaged = bytearray(whole)
        damaged[(7 * i) % 10] ^= 1 << (i % 8)
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match="damaged"):
            load_evaluation(saved)
        file.write_bytes(whole)
    assert_same(load_evaluation(saved), make_evaluation())


def test_a_missing_chunk_is_detected_although_zarr_reads_zeros(saved):
    chunk_files(saved)[-1].unlink()
    with pytest.raises(ValueError, match="column seed .* is damaged"):
        load_evaluation(saved)


@pytest.mark.parametrize("column", COLUMNS)
def test_a_missing_column_is_detected(saved, column):
    (saved / column / "zarr.json").unlink()
    with pytest.raises(ValueError, match="incomplete"):
        load_evaluation(saved)


def change_header(path, change):
    file = path / "zarr.json"
    metadata = json.loads(file.read_text())
    change(metadata["attributes"])
    file.write_text(json.dumps(metadata))


@pytest.mark.parametrize(
    "change",
    [
        lambda attributes: attributes["header"].update(player="another"),
        lambda attributes: attributes["header"]["world"].update(robots=5),
        lambda attributes: attributes.pop("header"),
        lambda attributes: attributes.pop("header_crc32"),
    ],
)
def test_a_changed_header_is_detected(saved, change):
    change_header(saved, change)
    with pytest.raises(ValueError, match="header of .* is damaged"):
        load_evaluation(saved)


@pytest.mark.parametrize("settings", [{"a_setting_of_tomorrow": 1}, {"robots": 1}])
def test_settings_of_another_version_are_refused(saved, settings):
    def change(attributes):
        attributes["header"]["world"].update(settings)
        attributes["header_crc32"] = evaluation_store._crc32(attributes["header"])

    change_header(saved, change)
    with pytest.raises(ValueError, match="another version"):
        load_evaluation(saved)


def test_anything_but_an_evaluation_is_refused(path):
    with pytest.raises(ValueError, match="missing"):
        load_evaluation(path)
    zarr_columns.save_rows(path, np.zeros(3, evaluation_store.EPISODE_DTYPE))
    with pytest.raises(ValueError, match="format"):
        load_evaluation(path)
