"""A policy in a file of its own: torch's network can load it, and what does not fit is refused."""

import dataclasses

import numpy as np
import pytest
from safetensors.torch import load_file, save_file

from actors.policy.network import load_snapshot, snapshot
from actors.rollout.vector_env import env_shape
from learner.checkpoints.manifest import CheckpointError
from learner.config import RunConfig
from learner.export.saved_policy import ONLINE, read_saved_policy, save_policy
from learner.update.networks import acting_network
from sim_core.config import WorldConfig

IN = WorldConfig(method="in", robots=3, groups=3)
CONFIGS = {
    "one hidden layer": RunConfig(hidden_sizes=(8,)),
    "three hidden layers": RunConfig(hidden_sizes=(8, 7, 6)),
    "dueling": RunConfig(network="dueling", hidden_sizes=(9, 8)),
    "pooled": RunConfig(world=IN, network="pooled", hidden_sizes=(8, 7)),
    "pooled, deeper": RunConfig(world=IN, network="pooled", hidden_sizes=(8, 7, 6)),
}


@pytest.fixture(params=CONFIGS)
def config(request):
    return CONFIGS[request.param]


@pytest.fixture
def network(config):
    return acting_network(config, env_shape(config.env))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "policy.safetensors"


def test_torch_reads_what_is_saved_and_the_other_way_round(config, network, path, tmp_path):
    weights, shape = snapshot(network, 77, 0.0), env_shape(config.env)
    save_policy(path, weights)
    tensors = {f"{ONLINE}{name}": tensor for name, tensor in network.state_dict().items()}
    found = load_file(path)
    assert found.keys() == tensors.keys() and all(found[name].equal(tensors[name]) for name in tensors)
    save_file(tensors, tmp_path / "torch.safetensors", metadata={"updates": "78"})
    for file, version in ((path, 77), (tmp_path / "torch.safetensors", 78)):
        again = read_saved_policy(file, config, shape)
        assert (again.version, again.row_size) == (version, weights.row_size)
        load_snapshot(network, again)
        for array, expected in zip(again.arrays, weights.arrays, strict=True):
            assert array.dtype == np.float32
            np.testing.assert_array_equal(array, expected)


@pytest.mark.parametrize("sizes", [(8,), (8, 7), (9, 7, 6), (8, 7, 6, 5)])
def test_another_network_is_refused(sizes, path):
    config = CONFIGS["three hidden layers"]
    save_policy(path, snapshot(acting_network(config, env_shape(config.env)), 1, 0.0))
    with pytest.raises(CheckpointError, match="takes other observations or actions"):
        read_saved_policy(path, dataclasses.replace(config, hidden_sizes=sizes), env_shape(config.env))


@pytest.mark.parametrize("content", [None, b"", b"no tensors in here"])
def test_a_damaged_file_is_refused(content, path, small_run):
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(CheckpointError, match="cannot be read"):
        read_saved_policy(path, small_run, env_shape(small_run.env))
