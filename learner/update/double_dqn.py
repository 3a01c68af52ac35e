"""The update as pure functions: Double DQN and DQN targets, losses and importance weights.

Algorithm 1 (Mnih et al. 2015) and Algorithm 2 (van Hasselt, Guez, Silver 2016) of the dissertation.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

LossName = Literal["huber", "mse"]


class Batch(NamedTuple):
    """Transitions as tensors: s_tm1 and s_t `[batch, *shape]`, a_tm1 int64, r_t, discount_t `[batch]`.

    `weight` `[batch]` is what each loss counts (importance weights); None where all count alike.
    """

    s_tm1: Tensor
    a_tm1: Tensor
    r_t: Tensor
    discount_t: Tensor
    s_t: Tensor
    weight: Tensor | None = None


def double_q_target(q_t_online: Tensor, q_t_target: Tensor, r_t: Tensor, discount_t: Tensor) -> Tensor:
    """R + discount * Q_target(s', argmax_a Q_online(s', a)), `[batch]` (Algorithm 2).

    Args:
      q_t_online, q_t_target: action values of the next state `[batch, actions]` by either network.
      r_t, discount_t: `[batch]`.
    """
    best = q_t_online.argmax(dim=1, keepdim=True)
    return r_t + discount_t * q_t_target.gather(1, best).squeeze(1)


def q_target(q_t_target: Tensor, r_t: Tensor, discount_t: Tensor) -> Tensor:
    """R + discount * max_a Q_target(s', a), `[batch]` (Algorithm 1)."""
    return r_t + discount_t * q_t_target.amax(dim=1)


def mean_loss(
    q_tm1: Tensor, a_tm1: Tensor, target: Tensor, loss: LossName = "huber", weight: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Mean loss of the taken actions' values against fixed targets.

    Args:
      q_tm1: action values `[batch, actions]`.
      a_tm1: taken actions `[batch]`.
      target: `[batch]`.
      loss: of a TD error d, Huber's (d^2 / 2 up to |d| = 1, |d| - 1/2 beyond) or d^2.
      weight: what each loss counts in the mean `[batch]`, None for 1.

    Returns:
      (loss, TD errors `[batch]`, target less value, detached).
    """
    chosen = q_tm1.gather(1, a_tm1.unsqueeze(1)).squeeze(1)
    fixed = target.detach()
    function = functional.smooth_l1_loss if loss == "huber" else functional.mse_loss
    if weight is None:
        mean = function(chosen, fixed)
    else:
        mean = (weight * function(chosen, fixed, reduction="none")).mean()
    return mean, (fixed - chosen).detach()


def importance_weights(probability: NDArray[np.float64], batch_size: int, exponent: float) -> NDArray[np.float32]:
    """(1 / (N P(i))) ** beta over the greatest of its minibatch, so that weights scale updates down only.

    Schaul et al. (2016), 3.4. N, the number of stored transitions, drops out.

    Args:
      probability: with which each transition was drawn, `[count]`, minibatch after minibatch.
      batch_size: transitions of a minibatch; divides count.
      exponent: beta.

    Returns:
      Weights `[count]` in (0, 1].
    """
    parts = probability.reshape(-1, batch_size)
    weights: NDArray[np.float64] = (parts.min(axis=1, keepdims=True) / parts) ** exponent
    return weights.ravel().astype(np.float32)


def as_batch(rows: dict[str, Tensor], part: slice) -> Batch:
    """One minibatch of a super-batch's columns."""
    return Batch(
        rows["observation"][part],
        rows["action"][part],
        rows["reward"][part],
        rows["discount"][part],
        rows["next_observation"][part],
        rows["weight"][part] if "weight" in rows else None,
    )


@torch.no_grad()
def targets(batch: Batch, online: torch.nn.Module, target: torch.nn.Module, double: bool) -> Tensor:
    """Targets `[batch]` of the chosen algorithm."""
    q_t_target = target(batch.s_t)
    if double:
        return double_q_target(online(batch.s_t), q_t_target, batch.r_t, batch.discount_t)
    return q_target(q_t_target, batch.r_t, batch.discount_t)
