"""The learner against an update written out by hand, and on tasks whose action values are known."""

import copy
import dataclasses
import math

import gymnasium as gym
import numpy as np
import pytest
import torch

from actors.policy.policy import Policy
from actors.rollout.vector_env import EnvShape
from actors.service.messages import transition_dtype
from learner.config import RunConfig
from learner.update.learner import Columns, Learner, learning_device
from sim_core.checks import ConfigError

RATE = 2e-3
ROW_OF_COUNTS = transition_dtype(gym.spaces.Box(-127, 127, (3,), np.int8))


@pytest.fixture
def make_learner(learner_config, learner_shape):
    """Function: a small learner with the given settings."""

    def make(num_actions=4, **settings):
        config = dataclasses.replace(learner_config, **settings)
        return Learner(config, learner_shape._replace(num_actions=num_actions))

    return make


def by_hand(config, optimiser, online, target, rows, weights):
    """One update of `online` by `optimiser`, written out: loop, loss, clipping, Adam."""
    s_tm1, s_t = (torch.from_numpy(rows[name].astype(np.float32)) for name in ("observation", "next_observation"))
    loss = torch.zeros(())
    for i, (row, weight) in enumerate(zip(rows, weights, strict=True)):
        with torch.no_grad():
            selector = online if config.algorithm == "double_dqn" else target
            best = selector(s_t[i : i + 1])[0].argmax()
            td_target = float(row["reward"]) + float(row["discount"]) * target(s_t[i : i + 1])[0, best]
        error = td_target - online(s_tm1[i : i + 1])[0, int(row["action"])]
        huber = error**2 / 2 if abs(error) <= 1 else abs(error) - 0.5
        loss = loss + float(weight) * (error**2 if config.loss == "mse" else huber) / len(rows)
    optimiser.zero_grad()
    loss.backward()
    norm = torch.sqrt(sum((parameter.grad**2).sum() for parameter in online.parameters()))
    for parameter in online.parameters():
        parameter.grad *= min(1.0, config.max_gradient_norm / float(norm))
    optimiser.step()
    return loss.item(), float(norm)


def polyak(target, online, rate):
    """Polyak averaging, parameter by parameter."""
    for name, parameter in target.state_dict().items():
        parameter.copy_((1 - rate) * parameter + rate * online.state_dict()[name])


def assert_same(network, other, **tolerance):
    for (name, tensor), expected in zip(network.state_dict().items(), other.state_dict().values(), strict=True):
        np.testing.assert_allclose(tensor.numpy(), expected.numpy(), err_msg=name, **tolerance)


OPTIONS = [
    {},
    {"loss": "mse"},
    {"network": "dueling"},
    {"target_update": "soft", "target_update_rate": 0.3},
    {"loss": "mse", "network": "dueling", "target_update": "soft", "target_update_rate": 0.02},
    {"policy_average_updates": 3},
]


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("options", OPTIONS, ids=lambda options: "-".join(map(str, options.values())) or "defaults")
@pytest.mark.parametrize("gradients", ["by_hand", "autograd"])
@pytest.mark.parametrize("algorithm", ["double_dqn", "dqn"])
def test_updates_equal_those_of_a_plain_loop(
    learner_config, learner_shape, make_rows, algorithm, gradients, options, weighted
):
    settings = {"algorithm": algorithm, "target_update_interval": 2, "gradients": gradients} | options
    config = dataclasses.replace(learner_config, **settings)
    learner = Learner(config, learner_shape)
    online, target = copy.deepcopy(learner.online), copy.deepcopy(learner.target)
    optimiser = torch.optim.Adam(online.parameters(), lr=RATE, fused=False)
    rows, losses, norms = make_rows(5 * 16), [], []
    weights = np.random.default_rng(0).uniform(0.1, 1, len(rows)) if weighted else np.ones(len(rows))
    for i in range(5):
        part = slice(16 * i, 16 * (i + 1))
        loss, norm = by_hand(config, optimiser, online, target, rows[part], weights[part])
        losses.append(loss)
        norms.append(norm)
        if config.target_update == "soft":
            polyak(target, online, config.target_update_rate)
        elif i % 2:
            target.load_state_dict(online.state_dict())
    stats = learner.update(rows, RATE, weights.astype(np.float32) if weighted else None)
    assert max(norms) > config.max_gradient_norm  # else clipping would not be tested
    assert_same(learner.online, online, rtol=0, atol=1e-6)
    assert_same(learner.target, target, rtol=0, atol=1e-6)
    assert stats.loss == pytest.approx(np.mean(losses), rel=1e-5)


def test_the_learning_rate_is_that_of_the_call(make_learner, make_rows):
    still, moving = make_learner(), make_learner()
    still.update(make_rows(16), 0.0)
    moving.update(make_rows(16), RATE)
    assert_same(still.online, make_learner().online, rtol=0)
    moved = (moving.online.layers[0].weight - still.online.layers[0].weight).detach().abs()
    assert float(moved.max()) == pytest.approx(RATE, rel=1e-3)  # Adam's first step is one learning rate


def test_one_call_equals_many(make_learner, make_rows):
    together, one_by_one, rows = make_learner(), make_learner(), make_rows(16 * 7)
    together.update(rows, RATE)
    for start in range(0, len(rows), 16):
        one_by_one.update(rows[start : start + 16], RATE)
    assert together.updates == one_by_one.updates == 7
    assert_same(together.online, one_by_one.online, rtol=0)
    assert_same(together.target, one_by_one.target, rtol=0)


def test_the_target_is_copied_every_c_updates_and_not_between(make_learner, make_rows):
    learner = make_learner()
    copied = copy.deepcopy(learner.online)
    for update in range(1, 10):
        learner.update(make_rows(16, seed=update), RATE)
        if update % 3 == 0:
            copied = copy.deepcopy(learner.online)
        assert_same(learner.target, copied, rtol=0)


def test_a_soft_target_is_the_exponential_average_of_the_online_networks(make_learner, make_rows):
    learner, rate, online = make_learner(target_update="soft", target_update_rate=0.25), 0.25, []
    start = learner.target.layers[0].weight.detach().clone()
    for update in range(6):
        learner.update(make_rows(16, seed=update), RATE)
        online.append(learner.online.layers[0].weight.detach().clone())
    expected = (1 - rate) ** 6 * start
    expected += sum(rate * (1 - rate) ** (5 - i) * weight for i, weight in enumerate(online))
    torch.testing.assert_close(learner.target.layers[0].weight.detach(), expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("network", ["plain", "dueling"])
def test_the_policy_is_the_moving_average_of_the_online_networks(make_learner, make_rows, network):
    learner, kept = make_learner(policy_average_updates=4, network=network), math.exp(-1 / 4)
    average = [parameter.detach().clone() for parameter in learner.online.parameters()]
    for update in range(6):
        learner.update(make_rows(16, seed=update), RATE)
        new = learner.online.parameters()
        average = [kept * mean + (1 - kept) * parameter.detach() for mean, parameter in zip(average, new, strict=True)]
    for parameter, mean in zip(learner.policy.parameters(), average, strict=True):
        torch.testing.assert_close(parameter.detach(), mean, rtol=1e-5, atol=1e-7)
    published = Policy(learner.weights(0.0)).values(make_rows(16)["observation"])
    inputs = torch.from_numpy(make_rows(16)["observation"].astype(np.float32))
    torch.testing.assert_close(torch.from_numpy(published), learner.policy(inputs).detach(), rtol=1e-4, atol=1e-5)
    assert not torch.equal(learner.policy(inputs), learner.online(inputs))


def test_a_soft_target_at_rate_1_is_the_online_network(make_learner, make_rows):
    learner = make_learner(target_update="soft", target_update_rate=1.0)
    learner.update(make_rows(16), RATE)
    assert_same(learner.target, learner.online, rtol=0)


@pytest.mark.parametrize("gradients", ["by_hand", "autograd"])
def test_td_errors_are_measured_before_each_update(make_learner, make_rows, gradients):
    learner, alone = (make_learner(gradients=gradients) for _ in range(2))
    rows, expected = make_rows(16 * 4), []
    for start in range(0, len(rows), 16):
        part = rows[start : start + 16]
        seen, reached = (torch.from_numpy(part[name]) for name in ("observation", "next_observation"))
        with torch.no_grad():
            best = alone.online(reached).argmax(dim=1)
            following = alone.target(reached)[range(16), best].numpy()
            chosen = alone.online(seen)[range(16), part["action"].tolist()].numpy()
        expected.append(part["reward"] + part["discount"] * following - chosen)
        alone.update(part, RATE)
    learner.update(rows, RATE)
    assert learner.td_errors.dtype == np.float32
    np.testing.assert_allclose(learner.td_errors, np.concatenate(expected), rtol=1e-5, atol=1e-6)


def test_columns_equal_the_rows_whatever_the_buffers_held_before(make_rows):
    columns_of = Columns()
    for count, seed in ((5, 0), (5, 1), (7, 2), (5, 3)):
        rows = make_rows(count, seed=seed).astype(ROW_OF_COUNTS)
        columns = columns_of(rows)
        assert columns.keys() == set(rows.dtype.names)
        for name, column in columns.items():
            assert column.dtype == (torch.int64 if name == "action" else torch.float32)
            np.testing.assert_array_equal(column.numpy(), rows[name])


def as_columns(rows):
    """The columns of the rows, as a shard draws them."""
    return {name: rows[name].copy() for name in rows.dtype.names}


@pytest.mark.parametrize("form", [np.copy, as_columns])
def test_the_rows_of_the_caller_are_not_changed(make_learner, make_rows, form):
    """The tensors of a call are buffers of the learner, which the next call overwrites, or arrays of the caller."""
    learner, first, second = make_learner(), form(make_rows(32)), form(make_rows(32, seed=1))
    learner.update(first, RATE)
    learner.update(second, RATE)
    for left, seed in ((first, 0), (second, 1)):
        for name in make_rows(0).dtype.names:
            np.testing.assert_array_equal(left[name], make_rows(32, seed=seed)[name])


@pytest.mark.parametrize("gradients", ["by_hand", "autograd"])
def test_rows_and_their_columns_give_the_same_updates(make_learner, make_rows, gradients):
    one, other = (make_learner(gradients=gradients) for _ in range(2))
    for seed in range(3):
        one.update(make_rows(64, seed=seed), RATE)
        other.update(as_columns(make_rows(64, seed=seed)), RATE)
    assert one.updates == other.updates == 12
    for a, b in zip(one.weights(0.0).arrays, other.weights(0.0).arrays, strict=True):
        np.testing.assert_array_equal(a, b)


def test_weights_of_1_change_nothing(make_learner, make_rows):
    plain, weighted = make_learner(), make_learner()
    plain.update(make_rows(32), RATE)
    weighted.update(make_rows(32), RATE, np.ones(32, np.float32))
    assert_same(plain.online, weighted.online, rtol=0)


def test_rows_of_weight_0_change_nothing(make_learner, make_rows):
    learner, other, rows = make_learner(), make_learner(), make_rows(16)
    weights = np.where(np.arange(16) < 8, 1, 0).astype(np.float32)
    learner.update(rows, RATE, weights)
    rows[8:] = make_rows(8, seed=4)
    other.update(rows, RATE, weights)
    assert_same(learner.online, other.online, rtol=0, atol=1e-7)


def test_the_device_is_cuda_if_there_is_one(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert [learning_device(name).type for name in ("auto", "cpu", "cuda")] == ["cuda", "cpu", "cuda"]
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert [learning_device(name).type for name in ("auto", "cpu")] == ["cpu", "cpu"]
    with pytest.raises(ConfigError, match="no CUDA device.*--device"):
        learning_device("cuda")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("options", OPTIONS, ids=lambda options: "-".join(map(str, options.values())) or "defaults")
@pytest.mark.parametrize("gradients", ["by_hand", "autograd"])
def test_a_learner_on_cuda_learns_the_same(make_learner, make_rows, gradients, options):
    here, there = (make_learner(gradients=gradients, device=device, **options) for device in ("cpu", "cuda"))
    assert there.device.type == "cuda"
    for learner in (here, there):
        learner.update(make_rows(16 * 6), RATE, np.linspace(0.1, 1, 16 * 6, dtype=np.float32))
    for array, expected in zip(there.weights(0.0).arrays, here.weights(0.0).arrays, strict=True):
        np.testing.assert_allclose(array, expected, atol=1e-4)
    np.testing.assert_allclose(there.td_errors, here.td_errors, atol=1e-3)
    moved = make_learner(gradients=gradients, **options)
    moved.set_state(there.get_state())
    moved.update(make_rows(16), RATE)
    there.update(make_rows(16), RATE)
    np.testing.assert_allclose(moved.td_errors, there.td_errors, atol=1e-3)


def test_stats_are_means(make_learner, make_rows):
    learner = make_learner()
    rows = make_rows(16)
    values = Policy(learner.weights(0.0)).values(rows["observation"])
    following = Policy(learner.weights(0.0)).values(rows["next_observation"]).max(axis=1)
    error = rows["reward"] + rows["discount"] * following - values[np.arange(16), rows["action"]]
    stats = learner.update(rows, RATE)
    assert stats.q_mean == pytest.approx(values.mean(), rel=1e-4)
    assert stats.td_error == pytest.approx(np.abs(error).mean(), rel=1e-4)


def test_the_seed_alone_decides_the_initial_network(make_learner):
    torch.manual_seed(123)
    before = torch.random.get_rng_state()
    first = make_learner()
    assert torch.equal(torch.random.get_rng_state(), before)
    torch.rand(3)
    assert_same(first.online, make_learner().online, rtol=0)
    assert_same(first.online, first.target, rtol=0)
    other = make_learner(seed=6).online.layers[0].weight
    assert not torch.equal(other, first.online.layers[0].weight)


def test_published_weights_are_a_copy_with_their_version(make_learner, make_rows):
    learner = make_learner()
    weights = learner.weights(12.5)
    kept = [array.copy() for array in weights.arrays]
    learner.update(make_rows(32), RATE)
    for array, before in zip(weights.arrays, kept, strict=True):
        np.testing.assert_array_equal(array, before)
    assert (weights.version, weights.time_s, learner.weights(0.0).version) == (0, 12.5, 2)


@pytest.mark.parametrize("options", OPTIONS, ids=lambda options: "-".join(map(str, options.values())) or "defaults")
@pytest.mark.parametrize("updates", [0, 4])
def test_a_restored_learner_goes_on_bit_for_bit(make_learner, make_rows, updates, options):
    learner = make_learner(**options)
    if updates:
        learner.update(make_rows(16 * updates), RATE)
    saved = learner.get_state()
    learner.update(make_rows(16 * 7, seed=1), RATE)
    resumed = make_learner(**options | {"seed": 77})
    resumed.update(make_rows(16, seed=9), RATE)
    resumed.set_state(saved)
    assert resumed.updates == updates
    resumed.update(make_rows(16 * 7, seed=1), RATE)
    expected = learner.get_state()
    assert expected.keys() == resumed.get_state().keys()
    for name, tensor in resumed.get_state().items():
        assert torch.equal(tensor, expected[name]), name


@pytest.mark.parametrize(
    "other", [{"hidden_sizes": (8, 7)}, {"hidden_sizes": (8,)}, {"num_actions": 3}, {"network": "dueling"}]
)
def test_a_state_of_another_shape_is_refused(make_learner, other):
    saved = make_learner(**other).get_state()
    with pytest.raises(ValueError, match="another shape"):
        make_learner().set_state(saved)


def one_hot_rows(steps, num_states):
    """Rows of (state, action, reward, discount, next state) with one-hot observations."""
    rows = np.zeros(len(steps), transition_dtype(gym.spaces.Box(0, 1, (num_states,), np.int8)))
    eye = np.eye(num_states, dtype=np.int8)
    for row, (state, action, reward, discount, following) in zip(rows, steps, strict=True):
        row["observation"], row["next_observation"] = eye[state], eye[following]
        row["action"], row["reward"], row["discount"] = action, reward, discount
    return rows


def train(rows, num_actions, updates, **settings):
    """Action values `[states, actions]` after updates over the whole of `rows` each."""
    space = gym.spaces.Box(0, 1, rows["observation"].shape[1:], np.int8)
    config = RunConfig(hidden_sizes=(32,), batch_size=len(rows), target_update_interval=25, device="cpu", **settings)
    learner = Learner(config, EnvShape(space, num_actions))
    for start in range(0, updates, 50):
        learner.update(np.tile(rows, 50), 1e-2 * (1 - start / updates) + 1e-4)
    return Policy(learner.weights(0.0)).values(np.eye(*space.shape))


@pytest.mark.parametrize("options", OPTIONS, ids=lambda options: "-".join(map(str, options.values())) or "defaults")
@pytest.mark.parametrize("algorithm", ["double_dqn", "dqn"])
def test_learns_a_contextual_bandit(algorithm, options):
    expected = np.random.default_rng(3).normal(size=(4, 3))
    steps = [
        (state, action, expected[state, action], 0.0, (state + 1) % 4) for state in range(4) for action in range(3)
    ]
    np.testing.assert_allclose(
        train(one_hot_rows(steps, 4), 3, 400, algorithm=algorithm, **options), expected, atol=0.02
    )


@pytest.mark.parametrize("algorithm", ["double_dqn", "dqn"])
def test_learns_a_chain_to_the_values_of_value_iteration(algorithm):
    """States 0..4: left at the wall earns 0.1 again and again, right from 4 earns 1 once and ends."""
    steps = []
    for state in range(5):
        steps.append((state, 0, 0.1 if state == 0 else 0.0, 0.9, max(state - 1, 0)))
        steps.append((state, 1, 1.0, 0.0, 4) if state == 4 else (state, 1, 0.0, 0.9, state + 1))
    values = np.zeros((5, 2))
    for _ in range(500):
        for state, action, reward, discount, following in steps:
            values[state, action] = reward + discount * values[following].max()
    np.testing.assert_allclose(train(one_hot_rows(steps, 5), 2, 1000, algorithm=algorithm), values, atol=0.03)
