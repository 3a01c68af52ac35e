"""Compiled updates equal those of PyTorch's autograd and Adam, for any shape of network and any options."""

import dataclasses

import numpy as np
import pytest
import torch

from actors.policy.network import PooledNetwork, QNetwork
from learner.update.adam import Adam
from learner.update.compiled_updates import CompiledUpdates
from learner.update.gradients import FlatNetwork
from learner.update.updates import TorchUpdates
from sim_core.config import WorldConfig

ROWS = [(5, 9, (16, 12)), (8, 7, (24, 32, 8)), (3, 4, (6,)), (1, 7, (8, 8))]
"""Rows of an observation, their elements, hidden sizes."""
SHAPES = [((16,), (64, 64), 8, 64), ((72,), (256, 256), 9, 32), ((3,), (5,), 2, 1), ((2, 4), (7, 6, 5), 4, 33)]
RATE = 1e-3
SOFT = {"target_update": "soft", "target_update_rate": 0.1}


def maker(ways, config, shape, num_actions):
    """(updates by `ways`, online network, target network, optimiser), the same at every call."""
    torch.manual_seed(0)
    sizes = (int(np.prod(shape)), config.hidden_sizes, num_actions)
    online, target = FlatNetwork(QNetwork(*sizes)), FlatNetwork(QNetwork(*sizes))
    optimiser = Adam(online.values)
    return ways(online, target, optimiser, config), online, target, optimiser


def pooled_maker(ways, config, rows, row_size):
    """As `maker`, with a pooled network of 6 actions."""
    torch.manual_seed(0)
    networks = [PooledNetwork(rows * row_size, config.hidden_sizes, 6, row_size) for _ in range(2)]
    online, target = map(FlatNetwork, networks)
    optimiser = Adam(online.values)
    return ways(online, target, optimiser, config), online, target, optimiser


def with_absent_rows(columns, rows, row_size, most):
    """The columns, in whose observations up to `most` rows are zeros."""
    rng = np.random.default_rng(3)
    for name in ("observation", "next_observation"):
        present = rng.integers(max(1, rows - most), rows + 1, size=len(columns[name]))
        tensor = columns[name].reshape(-1, rows, row_size)
        tensor[torch.from_numpy(np.arange(rows) >= present[:, None])] = 0.0
    return columns


@pytest.mark.parametrize("most", [0, 8])
@pytest.mark.parametrize("options", [{}, {"loss": "mse"} | SOFT, {"algorithm": "dqn"}, {"teacher_margin": 0.2}])
@pytest.mark.parametrize(("rows", "row_size", "hidden_sizes"), ROWS)
def test_an_update_of_a_pooled_network_equals_that_of_autograd(
    learner_config, rows, row_size, hidden_sizes, options, most
):
    settings = {"hidden_sizes": hidden_sizes, "batch_size": 24} | options
    config = dataclasses.replace(learner_config, **settings, network="pooled", world=WorldConfig(method="in"))
    compiled, online, target, _ = pooled_maker(CompiledUpdates, config, rows, row_size)
    plain, other_online, other_target, _ = pooled_maker(TorchUpdates, config, rows, row_size)
    columns = with_absent_rows(columns_of(5 * 24, (rows * row_size,), 6), rows, row_size, most)
    columns = taught(columns, 6) if "teacher_margin" in options else columns
    stats, errors = compiled(columns, RATE, 7)
    expected, expected_errors = plain(columns, RATE, 7)
    np.testing.assert_allclose(stats, expected, rtol=2e-5, atol=2e-6)
    np.testing.assert_allclose(errors, expected_errors, rtol=2e-5, atol=2e-5)
    scale = float(other_online.values.grad.abs().max())
    torch.testing.assert_close(online.values.grad, other_online.values.grad, rtol=1e-3, atol=1e-5 * scale)
    shared = sum(tensor.numel() for tensor in (*online.layers[0], *online.layers[1]))
    assert bool(online.values.grad[:shared].abs().max() > 1e-3 * scale) == (rows > 1)
    for flat, other in ((online, other_online), (target, other_target)):
        apart = (flat.values - other.values).detach().abs().mean()
        assert float(apart) < 2e-3 * RATE


def taught(columns, num_actions):
    """The columns, with a teacher in two of three rows."""
    rng = np.random.default_rng(4)
    count = len(columns["action"])
    weight = rng.uniform(0.2, 2.0, size=count) * (np.arange(count) % 3 > 0)
    teacher = torch.from_numpy(rng.integers(num_actions, size=count))
    return columns | {"teacher": teacher, "teacher_weight": torch.from_numpy(weight.astype(np.float32))}


def columns_of(count, shape, num_actions, seed=0, weighted=False):
    rng = np.random.default_rng(seed)
    found = {
        "observation": rng.normal(size=(count, *shape)),
        "next_observation": rng.normal(size=(count, *shape)),
        "reward": rng.normal(scale=2, size=count),  # TD errors on both sides of |d| = 1, where Huber's loss changes
        "discount": rng.choice([0.0, 0.97], size=count),
    }
    if weighted:
        found["weight"] = rng.uniform(0.1, 1.0, size=count)
    tensors = {name: torch.from_numpy(array.astype(np.float32)) for name, array in found.items()}
    return tensors | {"action": torch.from_numpy(rng.integers(num_actions, size=count))}


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("options", [{}, {"loss": "mse"}, SOFT, {"max_gradient_norm": 100.0}, {"teacher_margin": 0.3}])
@pytest.mark.parametrize("algorithm", ["double_dqn", "dqn"])
@pytest.mark.parametrize(("shape", "hidden_sizes", "num_actions", "size"), SHAPES)
def test_an_update_equals_that_of_autograd(
    learner_config, shape, hidden_sizes, num_actions, size, algorithm, options, weighted
):
    settings = {"hidden_sizes": hidden_sizes, "batch_size": size, "algorithm": algorithm, "gradients": "autograd"}
    config = dataclasses.replace(learner_config, **settings, **options)
    compiled, online, target, optimiser = maker(CompiledUpdates, config, shape, num_actions)
    plain, other_online, other_target, other_optimiser = maker(TorchUpdates, config, shape, num_actions)
    columns = columns_of(5 * size, shape, num_actions, weighted=weighted)
    columns = taught(columns, num_actions) if "teacher_margin" in options else columns
    stats, errors = compiled(columns, RATE, 7)
    expected, expected_errors = plain(columns, RATE, 7)
    np.testing.assert_allclose(stats, expected, rtol=2e-5, atol=2e-6)
    np.testing.assert_allclose(errors, expected_errors, rtol=2e-5, atol=2e-5)
    scale = float(other_online.values.grad.abs().max())
    assert scale > 1e-4
    torch.testing.assert_close(online.values.grad, other_online.values.grad, rtol=1e-3, atol=1e-5 * scale)
    state, other_state = optimiser.state, other_optimiser.state
    assert float(state["step"]) == float(other_state["step"]) == 5
    for name in ("exp_avg", "exp_avg_sq"):
        largest = float(other_state[name].abs().max())
        torch.testing.assert_close(state[name], other_state[name], rtol=1e-3, atol=1e-5 * largest)
    for flat, other in ((online, other_online), (target, other_target)):
        apart = (flat.values - other.values).detach().abs().mean()
        assert float(apart) < 1e-3 * RATE  # Adam's step for a gradient near 0 may have either sign


@pytest.mark.parametrize("change", [torch.nan, torch.inf])
def test_divergence_shows_in_the_statistics(learner_config, change):
    compiled, online, _, _ = maker(CompiledUpdates, dataclasses.replace(learner_config, hidden_sizes=(8, 8)), (6,), 3)
    columns = columns_of(16, (6,), 3)
    columns["reward"][3] = change
    stats, errors = compiled(columns, RATE, 0)
    assert not np.isfinite(stats.loss) and not np.isfinite(errors[3])
    assert np.isfinite(errors[[0, 1, 2]]).all()
    if np.isnan(change):
        assert online.values.detach().isnan().all()


def test_ties_are_broken_as_by_pytorch(learner_config):
    config = dataclasses.replace(learner_config, hidden_sizes=(8,), gradients="autograd")
    compiled, online, target, _ = maker(CompiledUpdates, config, (6,), 3)
    plain, other, _, _ = maker(TorchUpdates, config, (6,), 3)
    for network in (online, other):
        network.values.data.zero_()  # all actions are tied online; the target network tells them apart
    columns = columns_of(16, (6,), 3)
    errors = compiled(columns, RATE, 0)[1]
    np.testing.assert_allclose(errors, plain(columns, RATE, 0)[1], rtol=1e-5, atol=1e-6)
    values = target.network(columns["next_observation"])
    assert np.ptp(values.detach().numpy(), axis=1).min() > 1e-3
    td_targets = columns["reward"] + columns["discount"] * values[:, 0]
    np.testing.assert_allclose(errors, td_targets.detach().numpy(), rtol=1e-5, atol=1e-6)
