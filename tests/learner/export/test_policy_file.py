"""Reading a policy from a checkpoint."""

import dataclasses

import numpy as np
import pytest

from actors.rollout.vector_env import env_shape
from learner.checkpoints.checkpoint import Checkpoint
from learner.checkpoints.manifest import CheckpointError
from learner.config import RunConfig
from learner.export.policy_file import read_policy
from learner.export.saved_policy import read_saved_policy, save_policy
from learner.training.cluster import ProcessCluster
from sim_core.config import WorldConfig
from tests import checkpointing


def checkpoint_of(learner, folder):
    checkpointing.saved(learner, folder)
    return Checkpoint(folder, {"updates": 42})


@pytest.fixture
def saved(tmp_path, small_run):
    """A checkpoint of a learner, and the weights that it published."""
    learner = ProcessCluster(small_run, 0).learner
    return checkpoint_of(learner, tmp_path), learner.weights()


def test_a_dueling_policy_is_kept_as_the_plain_network_that_it_equals(tmp_path, small_run):
    config = dataclasses.replace(small_run, network="dueling", hidden_sizes=(9, 8))
    shape, learner = env_shape(config.env), ProcessCluster(config, 0).learner
    weights = learner.weights()
    save_policy(tmp_path / "policy.safetensors", weights)
    again = read_saved_policy(tmp_path / "policy.safetensors", config, shape)
    checkpoint = checkpoint_of(learner, tmp_path)
    kept = read_policy(checkpoint, config, shape)
    assert (kept.version, again.version) == (42, 0)
    assert [len(bias) for bias in weights.arrays[1::2]] == [9, 16, shape.num_actions]
    for copy in (again, kept):
        for array, expected in zip(copy.arrays, weights.arrays, strict=True):
            np.testing.assert_array_equal(array, expected)
    for other in (dataclasses.replace(config, network="plain"), dataclasses.replace(config, hidden_sizes=(9, 16))):
        with pytest.raises(CheckpointError, match="hidden_sizes, network"):
            read_policy(checkpoint, other, shape)


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
        with pytest.raises(CheckpointError, match="network, sectors, speed_levels, stop_action and sensor_counts"):
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
