"""Reading a policy from a checkpoint."""

import time

import numpy as np
import pytest

from actors.vector_env import env_shape
from learner.checkpoint import Checkpoint
from learner.cluster import process_cluster
from learner.config import RunConfig
from learner.manifest import CheckpointError
from learner.policy_file import read_policy
from sim_core.config import WorldConfig


@pytest.fixture
def saved(tmp_path, small_run):
    """A checkpoint of a learner, and the weights that it published."""
    learner = process_cluster(small_run, 0).learner
    learner.save(tmp_path)
    while learner.saved() is None:
        time.sleep(0.005)
    return Checkpoint(tmp_path, {"updates": 42}), learner.weights()[0].value


def test_the_policy_is_the_published_one(saved, small_run):
    checkpoint, published = saved
    weights = read_policy(checkpoint, small_run, env_shape(small_run.env))
    assert weights.version == 42
    for array, expected in zip(weights.arrays, published.arrays, strict=True):
        np.testing.assert_array_equal(array, expected)


def test_robots_may_differ_but_sectors_may_not(saved, small_run):
    checkpoint, _ = saved
    more = RunConfig(world=WorldConfig(robots=9, groups=3, sectors=4), hidden_sizes=(8,))
    read_policy(checkpoint, more, env_shape(more.env))
    for world in (WorldConfig(sectors=5), WorldConfig(sectors=4, stop_action=True)):
        with pytest.raises(CheckpointError, match="sectors, stop_action and hidden_sizes"):
            read_policy(checkpoint, small_run, env_shape(small_run.env._replace(world=world)))


def test_other_hidden_sizes_are_refused(saved):
    other = RunConfig(world=WorldConfig(robots=3, groups=2, sectors=4), hidden_sizes=(8, 8))
    with pytest.raises(CheckpointError):
        read_policy(saved[0], other, env_shape(other.env))


@pytest.mark.parametrize("content", [None, b"", b"no tensors in here"])
def test_a_damaged_file_is_refused(saved, small_run, content):
    path = saved[0].folder / "learner.safetensors"
    path.unlink()
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(CheckpointError):
        read_policy(saved[0], small_run, env_shape(small_run.env))
