"""The compiled policy against the network in torch."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.policy import network as networks
from actors.policy.network import DuelingNetwork, PooledNetwork, QNetwork, load_snapshot, snapshot
from actors.policy.policy import Policy, WeightsSnapshot


def make_network(size, hidden_sizes, num_actions, seed=0, kind="plain"):
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return networks.make_network(kind, size, hidden_sizes, num_actions)


def observations(shape, dtype, seed=0, batch=7):
    values = np.random.default_rng(seed).normal(scale=20, size=(batch, *shape))
    return values.clip(-120, 120).astype(dtype)


@given(
    shape=st.sampled_from([(1,), (5,), (2, 8), (3, 4)]),
    dtype=st.sampled_from([np.int8, np.float32, np.float64]),
    hidden_sizes=st.lists(st.integers(1, 20), min_size=1, max_size=3).map(tuple),
    num_actions=st.integers(1, 9),
    seed=st.integers(0, 1000),
    kind=st.sampled_from(["plain", "dueling"]),
)
@settings(max_examples=80, deadline=None)
def test_the_policy_computes_the_same_values_as_the_network(shape, dtype, hidden_sizes, num_actions, seed, kind):
    network = make_network(int(np.prod(shape)), hidden_sizes, num_actions, seed, kind)
    observation = observations(shape, dtype, seed)
    policy = Policy(snapshot(network, 0, 0.0))
    with torch.no_grad():
        expected = network(torch.from_numpy(observation)).numpy()
    values = policy.values(observation)
    assert values.dtype == np.float32 and values.shape == (7, num_actions)
    np.testing.assert_allclose(values, expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(policy.greedy(observation), values.argmax(axis=1))


def rows_of_groups(rows, row_size, batch=9, seed=0):
    """Observations `[batch, rows * row_size]` with between 0 and all other rows, and how many rows each has."""
    rng = np.random.default_rng(seed)
    values = rng.normal(scale=2, size=(batch, rows, row_size)).astype(np.float32)
    present = rng.integers(1, rows + 1, size=batch)
    values[np.arange(rows) >= present[:, None]] = 0.0
    return values, present


@given(
    rows=st.integers(1, 16),
    row_size=st.integers(1, 9),
    hidden_sizes=st.lists(st.integers(1, 20), min_size=1, max_size=3).map(tuple),
    seed=st.integers(0, 1000),
)
@settings(max_examples=60, deadline=None)
def test_a_pooled_policy_computes_the_same_values_as_its_network(rows, row_size, hidden_sizes, seed):
    torch.manual_seed(seed)
    network = PooledNetwork(rows * row_size, hidden_sizes, 5, row_size)
    values, present = rows_of_groups(rows, row_size, seed=seed)
    policy, rng = Policy(snapshot(network, 0, 0.0)), np.random.default_rng(seed)
    found = policy.values(values.reshape(9, -1))
    with torch.no_grad():
        np.testing.assert_allclose(found, network(torch.from_numpy(values.reshape(9, -1))), rtol=1e-4, atol=1e-5)
        loaded = PooledNetwork(rows * row_size, hidden_sizes, 5, row_size)
        load_snapshot(loaded, policy.weights)
        assert torch.equal(loaded(torch.from_numpy(values)), network(torch.from_numpy(values)))
    for i in range(len(present)):  # neither the order of the other groups nor the places of absent ones count
        values[i, 1:] = values[i, 1 + rng.permutation(rows - 1)]
    np.testing.assert_allclose(policy.values(values.reshape(9, -1)), found, rtol=1e-4, atol=1e-5)


def test_nan_weights_give_nan_values_of_a_pooled_network_too():
    network = PooledNetwork(12, (4, 5), 3, 4)
    with torch.no_grad():
        network.rows[0].weight.fill_(torch.nan)
    assert np.isnan(Policy(snapshot(network, 0, 0.0)).values(np.ones((2, 12)))).all()


def test_relu_follows_every_layer_but_the_last():
    identity = np.eye(2, dtype=np.float32)
    zero, one = np.zeros(2, np.float32), np.ones(2, np.float32)
    policy = Policy(WeightsSnapshot(0, 0.0, (identity, zero, -identity, -one)))
    # relu([3, -4]) = [3, 0]. A ReLU after the last layer would give zeros, no ReLU at all [-4, 3].
    np.testing.assert_array_equal(policy.values(np.array([[3.0, -4.0]])), [[-4.0, -1.0]])


def test_returned_values_are_copies():
    policy = Policy(snapshot(make_network(4, (6, 5), 3), 0, 0.0))
    first = policy.values(observations((4,), np.float32, seed=1))
    kept = first.copy()
    for batch in (7, 2, 7):
        policy.values(observations((4,), np.float32, seed=2, batch=batch))
    np.testing.assert_array_equal(first, kept)


def test_nan_weights_give_nan_values():
    nan = np.full((2, 1), np.nan, np.float32)
    zero = np.zeros(2, np.float32)
    assert np.isnan(
        Policy(WeightsSnapshot(0, 0.0, (nan, zero, np.eye(2, dtype=np.float32), zero))).values(np.ones((1, 1)))
    ).all()


def test_ties_are_broken_by_the_lowest_index():
    zeros = (np.zeros((3, 2), np.float32), np.zeros(3, np.float32))
    output = (np.zeros((4, 3), np.float32), np.array([1, 2, 2, 0], np.float32))
    np.testing.assert_array_equal(Policy(WeightsSnapshot(0, 0.0, zeros + output)).greedy(np.zeros((3, 2))), [1, 1, 1])


def streams(network, observation):
    """V(s) and A(s, a) of a dueling network, computed layer by layer from its parameters."""
    parameters = {name: tensor.detach().numpy().astype(float) for name, tensor in network.named_parameters()}
    x = observation.astype(float)
    for i in range(0, len(network.layers), 2):
        x = np.maximum(x @ parameters[f"layers.{i}.weight"].T + parameters[f"layers.{i}.bias"], 0)
    half = x.shape[1] // 2
    value, advantage = (
        hidden @ parameters[f"{name}.weight"].T + parameters[f"{name}.bias"]
        for name, hidden in (("value", x[:, :half]), ("advantage", x[:, half:]))
    )
    return value, advantage


@pytest.mark.parametrize("hidden_sizes", [(5,), (7, 6), (8, 7, 5)])
def test_a_dueling_network_computes_equation_9(hidden_sizes):
    """Q = V + A - mean A: the mean over actions is V, and a constant added to all advantages changes nothing."""
    network, observation = make_network(4, hidden_sizes, 3, kind="dueling"), observations((4,), np.float32)
    value, advantage = streams(network, observation)
    assert value.shape == (7, 1) and advantage.shape == (7, 3)
    with torch.no_grad():
        values = network(torch.from_numpy(observation))
        np.testing.assert_allclose(values, value + advantage - advantage.mean(axis=1, keepdims=True), rtol=1e-4)
        np.testing.assert_allclose(values.mean(dim=1), value[:, 0], rtol=1e-4, atol=1e-5)
        network.advantage.bias.add_(3.0)
        torch.testing.assert_close(network(torch.from_numpy(observation)), values, rtol=1e-4, atol=1e-5)


def test_each_stream_of_a_dueling_network_has_the_last_hidden_width():
    shapes = [tuple(parameter.shape) for parameter in DuelingNetwork(4, (8, 5), 3).parameters()]
    assert shapes == [(8, 4), (8,), (10, 8), (10,), (1, 5), (1,), (3, 5), (3,)]
    arrays = snapshot(DuelingNetwork(4, (8, 5), 3), 0, 0.0).arrays
    assert [array.shape for array in arrays] == [tuple(p.shape) for p in QNetwork(4, (8, 10), 3).parameters()]


def test_snapshots_round_trip_and_are_copies():
    network = make_network(6, (5, 4), 3)
    weights = snapshot(network, 17, 4.5)
    assert (weights.version, weights.time_s) == (17, 4.5)
    other = make_network(6, (5, 4), 3, seed=9)
    for array in weights.arrays:
        array.flags.writeable = False  # like arrays from Ray
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
