"""Recorded episodes: round trip, a layout that zarr alone can read, and refusals."""

import numpy as np
import pytest
import zarr

from actors.evaluation.trajectory import TIME_KEYS, Episode, load_episodes, save_episodes
from sim_core.config import WorldConfig

CONFIG = WorldConfig(robots=3, groups=2, reward_clock="horizon", stop_action=True)


def make_episode(length, seed):
    rng = np.random.default_rng(seed)
    return Episode(
        position=rng.normal(size=(length, 6, 2)).astype(np.float32),
        velocity=rng.normal(size=(length, 6, 2)).astype(np.float32),
        machine=rng.integers(0, 4, (length, 6)).astype(np.int8),
        action=np.append(rng.integers(0, 9, length - 1), -1),
        reward=np.append(rng.normal(size=length - 1), 0).astype(np.float32),
        goal=rng.normal(size=(2, 2)).astype(np.float32),
        learner=seed % 6,
        outcome=1 + seed % 5,
        seed=2_000_000_000 + seed,
    )


def assert_same(first, second):
    for name in Episode._fields:
        a, b = getattr(first, name), getattr(second, name)
        np.testing.assert_array_equal(a, b, err_msg=name)
        assert np.asarray(a).dtype == np.asarray(b).dtype, name


@pytest.fixture
def path(tmp_path):
    return tmp_path / "episodes.zarr"


def test_round_trip_of_episodes_of_different_lengths(path):
    episodes = [make_episode(length, seed) for seed, length in enumerate((5, 2, 9))]
    save_episodes(path, episodes, CONFIG)
    loaded, config = load_episodes(path)
    assert config == CONFIG and len(loaded) == 3
    for first, second in zip(episodes, loaded, strict=True):
        assert_same(first, second)


def test_what_only_some_worlds_have_is_stored_where_they_have_it(path):
    episodes = [make_episode(length, seed) for seed, length in enumerate((5, 3))]
    rng = np.random.default_rng(0)
    full = [
        one._replace(
            sensed=np.where(rng.random(one.position.shape) < 0.3, np.nan, one.position).astype(np.float32),
            asked=rng.normal(size=(len(one.action), 2)).astype(np.float32),
        )
        for one in episodes
    ]
    save_episodes(path, full, CONFIG)
    for first, second in zip(full, load_episodes(path)[0], strict=True):
        assert_same(first, second)
    save_episodes(path, episodes, CONFIG)
    assert set(zarr.open_group(str(path), mode="r")["data"].array_keys()) == set(TIME_KEYS)


def test_the_layout_is_that_of_diffusion_policy(path):
    episodes = [make_episode(5, 0), make_episode(2, 1)]
    save_episodes(path, episodes, CONFIG)
    root = zarr.open_group(str(path), mode="r")
    np.testing.assert_array_equal(root["meta/episode_ends"][...], [5, 7])
    assert all(root[f"data/{key}"].shape[0] == 7 for key in TIME_KEYS)
    np.testing.assert_array_equal(root["data/position"][5:7], episodes[1].position)


def test_saving_again_replaces_the_older_episodes(path):
    save_episodes(path, [make_episode(5, 0)], CONFIG)
    save_episodes(path, [make_episode(3, 4)], CONFIG)
    loaded, _ = load_episodes(path)
    assert_same(loaded[0], make_episode(3, 4))
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_a_failed_save_leaves_the_older_episodes(path):
    save_episodes(path, [make_episode(5, 0)], CONFIG)
    odd = make_episode(3, 1)._replace(goal=np.zeros((3, 2), np.float32))
    with pytest.raises(ValueError):
        save_episodes(path, [make_episode(2, 0), odd], CONFIG)
    assert_same(load_episodes(path)[0][0], make_episode(5, 0))
    with pytest.raises(ValueError, match="no episodes"):
        save_episodes(path, [], CONFIG)


def test_anything_but_recorded_episodes_is_refused(path):
    with pytest.raises(ValueError, match="shoal watch"):
        load_episodes(path)
    zarr.open_group(str(path), mode="w").attrs["format"] = "shoal-trajectories-0"
    with pytest.raises(ValueError, match="format"):
        load_episodes(path)


@pytest.mark.parametrize("missing", ["data/reward", "meta/goal", "meta/episode_ends"])
def test_missing_columns_are_refused(path, missing):
    save_episodes(path, [make_episode(5, 0)], CONFIG)
    (path / missing / "zarr.json").unlink()
    with pytest.raises(ValueError, match="record the episodes again"):
        load_episodes(path)
