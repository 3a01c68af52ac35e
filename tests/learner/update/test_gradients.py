"""Hand-written gradients equal those of autograd for any shape of network; flat parameters are the network's own."""

import numpy as np
import pytest
import torch

from actors.policy.network import make_network
from learner.update.double_dqn import Batch
from learner.update.gradients import AutogradGradients, FlatNetwork, HandWrittenGradients


def networks(observation_size, hidden_sizes, num_actions, seed=0, kind="plain"):
    torch.manual_seed(seed)
    return [FlatNetwork(make_network(kind, observation_size, hidden_sizes, num_actions)) for _ in range(2)]


def random_batch(size, shape, num_actions, seed=0, weighted=False, taught=False):
    rng = np.random.default_rng(seed)

    def tensor(array):
        return torch.from_numpy(array.astype(np.float32))

    return Batch(
        s_tm1=tensor(rng.normal(size=(size, *shape))),
        a_tm1=torch.from_numpy(rng.integers(num_actions, size=size)),
        r_t=tensor(rng.normal(scale=2, size=size)),  # TD errors on both sides of |d| = 1, where Huber's loss changes
        discount_t=tensor(rng.choice([0.0, 0.97], size=size)),
        s_t=tensor(rng.normal(size=(size, *shape))),
        weight=tensor(rng.uniform(0.1, 1.0, size=size)) if weighted else None,
        teacher=torch.from_numpy(rng.integers(num_actions, size=size)) if taught else None,
        teacher_weight=tensor(rng.uniform(0.0, 2.0, size=size)) if taught else None,
    )


@pytest.mark.parametrize("kind", ["plain", "dueling"])
@pytest.mark.parametrize(("loss", "weighted"), [("huber", False), ("huber", True), ("mse", False), ("mse", True)])
@pytest.mark.parametrize("double", [True, False])
@pytest.mark.parametrize(
    ("shape", "hidden_sizes", "num_actions", "size"),
    [((16,), (128, 128), 8, 256), ((72,), (256, 256), 9, 64), ((3,), (5,), 2, 1), ((2, 4), (7, 6, 5), 4, 33)],
)
@pytest.mark.parametrize("taught", [False, True])
def test_hand_written_gradients_equal_autograd(
    double, shape, hidden_sizes, num_actions, size, loss, weighted, kind, taught
):
    online, target = networks(int(np.prod(shape)), hidden_sizes, num_actions, kind=kind)
    batch = random_batch(size, shape, num_actions, weighted=weighted, taught=taught)
    online.values.grad.fill_(torch.nan)  # an element that is not written would show
    found = HandWrittenGradients(online, target, double, loss, 0.3)(batch)
    by_hand = online.values.grad.clone()
    online.values.grad.fill_(torch.nan)
    expected = AutogradGradients(online, target, double, loss, 0.3)(batch)
    assert float(by_hand.abs().max()) > 1e-3
    scale = float(online.values.grad.abs().max())
    torch.testing.assert_close(by_hand, online.values.grad, rtol=1e-4, atol=3e-6 * scale)
    torch.testing.assert_close(torch.stack(found[:3]), torch.stack(expected[:3]), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(found.td_errors, expected.td_errors, rtol=1e-5, atol=3e-6)


@pytest.mark.parametrize("kind", ["plain", "dueling"])
@pytest.mark.parametrize(("loss", "weighted"), [("huber", False), ("mse", True)])
def test_hand_written_gradients_equal_finite_differences(kind, loss, weighted):
    online, target = networks(4, (6, 5), 3, seed=2, kind=kind)
    for flat in (online, target):
        flat.network.double()
    online, target = FlatNetwork(online.network), FlatNetwork(target.network)
    parts = random_batch(20, (4,), 3, weighted=weighted)
    batch = Batch(*(part.double() if part is not None and part.is_floating_point() else part for part in parts))
    gradients = HandWrittenGradients(online, target, False, loss)
    gradients(batch)
    slopes, step = online.values.grad.clone(), 1e-6
    for i in range(len(slopes)):
        losses = []
        for change in (step, -2 * step):
            online.values.data[i] += change
            losses.append(float(gradients(batch).loss))
        online.values.data[i] += step
        assert float(slopes[i]) == pytest.approx((losses[0] - losses[1]) / (2 * step), abs=1e-7)


@pytest.mark.parametrize("kind", ["plain", "dueling"])
def test_flat_parameters_are_those_of_the_network(kind):
    flat, _ = networks(3, (4,), 2, kind=kind)
    before = [parameter.detach().clone() for parameter in flat.network.parameters()]
    assert torch.equal(flat.values.data, torch.cat([parameter.reshape(-1) for parameter in before]))
    flat.values.data.add_(1.0)
    for parameter, old in zip(flat.network.parameters(), before, strict=True):
        assert torch.equal(parameter, old + 1.0)
    flat.network.load_state_dict({name: tensor * 0 + 3 for name, tensor in flat.network.state_dict().items()})
    assert (flat.values == 3).all() and all((weight == 3).all() and (bias == 3).all() for weight, bias in flat.layers)


def test_a_copy_is_independent():
    flat, _ = networks(3, (4,), 2)
    other = flat.copy()
    assert torch.equal(other.values, flat.values)
    flat.values.data.zero_()
    assert float(other.values.detach().abs().max()) > 0


@pytest.mark.parametrize("limit", [0.1, 5.0, 100.0])
def test_gradients_are_clipped_as_pytorch_clips_them(limit):
    flat, _ = networks(3, (4,), 2)
    slopes = torch.randn_like(flat.values) * 3
    flat.values.grad.copy_(slopes)
    flat.clip_gradients(limit)
    other = torch.nn.Parameter(flat.values.detach().clone())
    other.grad = slopes.clone()
    norm = float(torch.nn.utils.clip_grad_norm_([other], limit))
    torch.testing.assert_close(flat.values.grad, other.grad)
    assert float(flat.values.grad.norm()) == pytest.approx(min(norm, limit), rel=1e-5)
