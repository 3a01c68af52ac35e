"""The policy in numpy against the network in torch."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.network import Policy, QNetwork, WeightsSnapshot, load_snapshot, snapshot


def make_network(size, hidden_sizes, num_actions, seed=0):
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return QNetwork(size, hidden_sizes, num_actions)


def observations(shape, dtype, seed=0, batch=7):
    values = np.random.default_rng(seed).normal(scale=20, size=(batch, *shape))
    return values.clip(-120, 120).astype(dtype)


@given(
    shape=st.sampled_from([(1,), (5,), (2, 8), (3, 4)]),
    dtype=st.sampled_from([np.int8, np.float32, np.float64]),
    hidden_sizes=st.lists(st.integers(1, 20), min_size=1, max_size=3).map(tuple),
    num_actions=st.integers(1, 9),
    seed=st.integers(0, 1000),
)
@settings(max_examples=40, deadline=None)
def test_policy_computes_what_the_network_computes(shape, dtype, hidden_sizes, num_actions, seed):
    network = make_network(int(np.prod(shape)), hidden_sizes, num_actions, seed)
    observation = observations(shape, dtype, seed)
    policy = Policy(snapshot(network, 0, 0.0))
    with torch.no_grad():
        expected = network(torch.from_numpy(observation)).numpy()
    values = policy.values(observation)
    assert values.dtype == np.float32 and values.shape == (7, num_actions)
    np.testing.assert_allclose(values, expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(policy.greedy(observation), values.argmax(axis=1))


def test_relu_stands_between_layers_and_not_after_the_last():
    identity = np.eye(2, dtype=np.float32)
    zero, one = np.zeros(2, np.float32), np.ones(2, np.float32)
    policy = Policy(WeightsSnapshot(0, 0.0, (identity, zero, -identity, -one)))
    # relu([3, -4]) = [3, 0]; a ReLU at the end would give zeros, none at all [-4, 3].
    np.testing.assert_array_equal(policy.values(np.array([[3.0, -4.0]])), [[-4.0, -1.0]])


def test_ties_go_to_the_lowest_index():
    zeros = (np.zeros((3, 2), np.float32), np.zeros(3, np.float32))
    output = (np.zeros((4, 3), np.float32), np.array([1, 2, 2, 0], np.float32))
    np.testing.assert_array_equal(Policy(WeightsSnapshot(0, 0.0, zeros + output)).greedy(np.zeros((3, 2))), [1, 1, 1])


def test_snapshot_round_trip_and_copies():
    network = make_network(6, (5, 4), 3)
    weights = snapshot(network, 17, 4.5)
    assert (weights.version, weights.time_s) == (17, 4.5)
    other = make_network(6, (5, 4), 3, seed=9)
    load_snapshot(other, weights)
    again = snapshot(other, 17, 4.5)
    for first, second in zip(weights.arrays, again.arrays, strict=True):
        np.testing.assert_array_equal(first, second)
    kept = [array.copy() for array in weights.arrays]
    with torch.no_grad():
        for parameter in [*network.parameters(), *other.parameters()]:
            parameter.add_(1.0)
    for array, before in zip(weights.arrays, kept, strict=True):
        np.testing.assert_array_equal(array, before)


@pytest.mark.parametrize("shape", [(6, (5, 4), 2), (7, (5, 4), 3), (6, (4, 5), 3), (6, (5,), 3), (6, (5, 4, 4), 3)])
def test_weights_of_another_shape_are_refused(shape):
    network = make_network(6, (5, 4), 3)
    before = snapshot(network, 0, 0.0)
    with pytest.raises(ValueError, match="another shape"):
        load_snapshot(network, snapshot(make_network(*shape), 0, 0.0))
    for array, kept in zip(snapshot(network, 0, 0.0).arrays, before.arrays, strict=True):
        np.testing.assert_array_equal(array, kept)
