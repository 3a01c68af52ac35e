"""TD targets and losses against numbers computed by hand and brute force."""

import numpy as np
import pytest
import torch

from learner.update.double_dqn import margin_losses, mean_loss, minibatch, td_targets

# Row 0: both networks prefer action 1. Row 1: online prefers 0, target 2 - there the algorithms differ.
ONLINE = torch.tensor([[1.0, 3.0, 2.0], [5.0, 4.0, 1.0]])
TARGET = torch.tensor([[10.0, 30.0, 20.0], [-1.0, 2.0, 8.0]])
REWARD, DISCOUNT = torch.tensor([0.5, -1.0]), torch.tensor([0.9, 0.5])


def test_double_dqn_by_hand():
    expected = [0.5 + 0.9 * 30, -1.0 + 0.5 * -1.0]
    assert td_targets(TARGET, ONLINE, REWARD, DISCOUNT).tolist() == pytest.approx(expected)


def test_dqn_by_hand():
    expected = [0.5 + 0.9 * 30, -1.0 + 0.5 * 8.0]
    assert td_targets(TARGET, TARGET, REWARD, DISCOUNT).tolist() == pytest.approx(expected)


def test_both_algorithms_agree_where_both_networks_prefer_the_same_action():
    equal = td_targets(TARGET, ONLINE, REWARD, DISCOUNT) == td_targets(TARGET, TARGET, REWARD, DISCOUNT)
    assert equal.tolist() == [True, False]
    assert torch.equal(td_targets(TARGET, TARGET, REWARD, DISCOUNT), REWARD + DISCOUNT * TARGET.amax(dim=1))


def test_a_discount_of_0_leaves_the_reward():
    zero = torch.zeros(2)
    assert torch.equal(td_targets(TARGET, ONLINE, REWARD, zero), REWARD)
    assert torch.equal(td_targets(TARGET, TARGET, REWARD, zero), REWARD)


@pytest.mark.parametrize("double", [True, False])
def test_targets_equal_a_loop(make_rows, double):
    rows = make_rows(40, seed=1)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        online, target = torch.nn.Linear(3, 4), torch.nn.Linear(3, 4)
    values = [
        rows["next_observation"] @ net.weight.detach().numpy().T + net.bias.detach().numpy() for net in (online, target)
    ]
    expected = []
    for i, row in enumerate(rows):
        best = max(range(4), key=lambda a, i=i: values[0 if double else 1][i][a])
        expected.append(row["reward"] + row["discount"] * values[1][i][best])
    reward, discount, s_t = (torch.from_numpy(rows[name].copy()) for name in ("reward", "discount", "next_observation"))
    with torch.no_grad():
        result = td_targets(target(s_t), (online if double else target)(s_t), reward, discount)
    np.testing.assert_allclose(result.numpy(), expected, rtol=1e-5, atol=1e-5)


def test_the_loss_is_the_mean_huber_loss_of_the_taken_actions():
    q_tm1 = torch.tensor([[0.0, 9.0], [9.0, 1.0], [2.0, 9.0]])
    target = torch.tensor([0.5, 4.0, -0.25])
    loss, td_error = mean_loss(q_tm1, torch.tensor([0, 1, 0]), target)
    assert td_error.tolist() == [0.5, 3.0, -2.25]
    assert loss.item() == pytest.approx((0.5 * 0.25 + (3.0 - 0.5) + (2.25 - 0.5)) / 3)


def test_the_mean_squared_error_of_the_taken_actions_by_hand():
    q_tm1 = torch.tensor([[0.0, 9.0], [9.0, 1.0]])
    target, weight = torch.tensor([0.5, 4.0]), torch.tensor([1.0, 0.1])
    assert mean_loss(q_tm1, torch.tensor([0, 1]), target, "mse")[0].item() == pytest.approx((0.25 + 9) / 2)
    assert mean_loss(q_tm1, torch.tensor([0, 1]), target, "mse", weight)[0].item() == pytest.approx((0.25 + 0.9) / 2)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("name", ["huber", "mse"])
def test_loss_and_gradient_equal_the_closed_form(name, weighted):
    rng = np.random.default_rng(0)
    errors = np.concatenate([rng.normal(scale=2, size=200), [1.0, -1.0, 0.0, 0.999, -1.001]])
    weights = rng.uniform(0.1, 1.0, len(errors)) if weighted else np.ones(len(errors))
    q_tm1 = torch.zeros((len(errors), 2), requires_grad=True)
    actions, target = torch.ones(len(errors), dtype=torch.int64), torch.from_numpy(errors).float()
    loss, _ = mean_loss(q_tm1, actions, target, name, torch.from_numpy(weights).float() if weighted else None)
    size = np.abs(errors)
    losses = np.where(size <= 1, errors**2 / 2, size - 0.5) if name == "huber" else errors**2
    slopes = errors.clip(-1, 1) if name == "huber" else 2 * errors
    assert loss.item() == pytest.approx((weights * losses).mean(), rel=1e-5)
    loss.backward()
    np.testing.assert_allclose(q_tm1.grad[:, 1], -weights * slopes / len(errors), rtol=1e-5, atol=1e-9)
    assert not q_tm1.grad[:, 0].any()


def test_the_margin_loss_by_hand():
    """The teacher's action leads by more than the margin, by less, is behind, and ties with the margin."""
    q = torch.tensor([[1.0, 0.5, 0.0], [1.0, 0.75, 0.0], [0.0, 0.25, 2.0], [1.0, 0.5, 1.0]])
    teacher = torch.tensor([0, 0, 1, 0])
    losses, rivals = margin_losses(q, teacher, 0.5)
    assert losses.tolist() == [0.0, 0.25, 2.25, 0.5] and rivals.tolist() == [0, 1, 2, 2]


def test_the_margin_loss_equals_a_loop_and_so_does_its_gradient():
    rng = np.random.default_rng(0)
    q = torch.tensor(rng.normal(size=(50, 7)), requires_grad=True)
    teacher = torch.from_numpy(rng.integers(7, size=50))
    losses, _ = margin_losses(q, teacher, 0.4)
    losses.sum().backward()
    for row in range(50):
        values = q[row].detach().numpy()
        raised = [values[a] + 0.4 * (a != teacher[row]) for a in range(7)]
        assert losses[row].item() == pytest.approx(max(raised) - values[teacher[row]])
        slope = np.zeros(7)
        slope[int(np.argmax(raised))] += 1
        slope[teacher[row]] -= 1
        np.testing.assert_array_equal(q.grad[row], slope)


def test_no_gradient_flows_into_the_target():
    online, target = torch.ones((2, 2), requires_grad=True), torch.zeros(2, requires_grad=True)
    loss, td_error = mean_loss(online, torch.tensor([0, 1]), target * 3)
    loss.backward()
    assert target.grad is None and online.grad is not None
    assert not td_error.requires_grad


def test_a_minibatch_is_a_slice_of_the_columns(make_rows):
    columns = {name: torch.from_numpy(make_rows(10)[name].copy()) for name in make_rows(10).dtype.names}
    batch = minibatch(columns, slice(4, 7))
    rows = make_rows(10)[4:7]
    names = ("observation", "action", "reward", "discount", "next_observation")
    for tensor, name in zip(batch[:5], names, strict=True):
        np.testing.assert_array_equal(tensor.numpy(), rows[name])
    assert batch.weight is None
    columns["weight"] = torch.arange(10.0)
    assert minibatch(columns, slice(4, 7)).weight.tolist() == [4.0, 5.0, 6.0]
