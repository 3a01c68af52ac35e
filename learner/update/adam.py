"""Adam over one flat tensor (Kingma and Ba 2015, Algorithm 1).

The constructor of `torch.optim.Adam` imports PyTorch's compiler, which takes a second of CPU time and much memory in
every process that learns. PyTorch's own function behind it does not.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.optim.adam import adam

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-8
"""PyTorch's defaults."""


class Adam:
    """Adam's state, and its steps by PyTorch's fused kernel.

    Args:
      values: the parameters, `[count]` float32; `values.grad` are their gradients.

    Attributes:
      state: `step`, a float32 scalar; `exp_avg` and `exp_avg_sq`, the moments, `[count]` float32. Tensors keep their
        memory, so that a kernel may update them.
    """

    def __init__(self, values: nn.Parameter) -> None:
        self._values = values
        self.state = {
            "step": torch.zeros((), dtype=torch.float32, device=values.device),
            "exp_avg": torch.zeros_like(values.data),
            "exp_avg_sq": torch.zeros_like(values.data),
        }

    @torch.no_grad()
    def step(self, learning_rate: float) -> None:
        """Makes one step against the gradients."""
        assert self._values.grad is not None
        adam(
            [self._values],
            [self._values.grad],
            [self.state["exp_avg"]],
            [self.state["exp_avg_sq"]],
            [],
            [self.state["step"]],
            fused=True,
            amsgrad=False,
            beta1=BETA1,
            beta2=BETA2,
            lr=learning_rate,
            weight_decay=0.0,
            eps=EPSILON,
            maximize=False,
        )

    def set_state(self, saved: Mapping[str, Tensor]) -> None:
        """Restores a state; a tensor that is missing, as before the first step of earlier versions, becomes 0.

        Raises:
          RuntimeError: a tensor has another shape.
        """
        for name, tensor in self.state.items():
            tensor.zero_() if name not in saved else tensor.copy_(saved[name])
