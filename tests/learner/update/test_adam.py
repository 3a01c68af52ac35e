"""Adam is PyTorch's: the same parameters and state, step by step, and without PyTorch's compiler."""

import pytest
import torch

from learner.update.adam import Adam
from tests.contract.test_imports import modules_after

RATES = (1e-2, 1e-3, 3e-4)


def parameters():
    values = torch.nn.Parameter(torch.randn(1_003, generator=torch.Generator().manual_seed(0)))
    values.grad = torch.zeros_like(values)
    return values


def steps(values, step):
    gradients = torch.Generator().manual_seed(1)
    for i in range(30):
        values.grad.copy_(torch.randn(values.shape, generator=gradients))
        step(RATES[i % len(RATES)])


def test_steps_equal_those_of_torch_optim():
    ours, theirs = parameters(), parameters()
    adam, reference = Adam(ours), torch.optim.Adam([theirs], fused=True)

    def step(rate):
        reference.param_groups[0]["lr"] = rate
        reference.step()

    steps(ours, adam.step)
    steps(theirs, step)
    assert torch.equal(ours, theirs)
    assert not torch.equal(ours, parameters())
    for name, tensor in reference.state[theirs].items():
        assert torch.equal(adam.state[name], tensor), name


def test_a_restored_state_goes_on_bit_for_bit_in_the_same_memory():
    first, second = parameters(), parameters()
    one, other = Adam(first), Adam(second)
    steps(first, one.step)
    second.data.copy_(first.data)
    memory = {name: tensor.data_ptr() for name, tensor in other.state.items()}
    other.set_state({name: tensor.clone() for name, tensor in one.state.items()})
    assert memory == {name: tensor.data_ptr() for name, tensor in other.state.items()}
    steps(first, one.step)
    steps(second, other.step)
    assert torch.equal(first, second)
    other.set_state({})
    assert not any(tensor.any() for tensor in other.state.values())
    with pytest.raises(RuntimeError):
        other.set_state({"exp_avg": torch.zeros(3)})


def test_the_compiler_is_not_imported():
    code = """
import torch
from learner.update.adam import Adam
values = torch.nn.Parameter(torch.zeros(3))
values.grad = torch.ones(3)
Adam(values).step(1e-3)
"""
    assert not {"torch._dynamo", "sympy"} & modules_after(code)
