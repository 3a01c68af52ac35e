"""The update as pure functions: Double DQN and DQN targets, and their loss.

Algorithm 1 (Mnih et al. 2015) and Algorithm 2 (van Hasselt, Guez, Silver 2016) of the dissertation.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional


class Batch(NamedTuple):
    """Transitions as tensors: s_tm1 and s_t `[batch, *shape]`, a_tm1 int64, r_t, discount_t `[batch]`."""

    s_tm1: Tensor
    a_tm1: Tensor
    r_t: Tensor
    discount_t: Tensor
    s_t: Tensor


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


def huber_loss(q_tm1: Tensor, a_tm1: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Mean Huber loss (delta = 1) of the taken actions' values against fixed targets.

    Returns:
      (loss, TD errors `[batch]`, target less value, detached).
    """
    chosen = q_tm1.gather(1, a_tm1.unsqueeze(1)).squeeze(1)
    fixed = target.detach()
    return functional.smooth_l1_loss(chosen, fixed), (fixed - chosen).detach()


def as_batch(rows: dict[str, Tensor], part: slice) -> Batch:
    """One minibatch of a super-batch's columns."""
    return Batch(
        rows["observation"][part],
        rows["action"][part],
        rows["reward"][part],
        rows["discount"][part],
        rows["next_observation"][part],
    )


@torch.no_grad()
def targets(batch: Batch, online: torch.nn.Module, target: torch.nn.Module, double: bool) -> Tensor:
    """Targets `[batch]` of the chosen algorithm."""
    q_t_target = target(batch.s_t)
    if double:
        return double_q_target(online(batch.s_t), q_t_target, batch.r_t, batch.discount_t)
    return q_target(q_t_target, batch.r_t, batch.discount_t)
