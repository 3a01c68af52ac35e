"""The update as pure functions: TD targets and losses.

Algorithm 1 (DQN: Mnih et al. 2015) and Algorithm 2 (Double DQN: van Hasselt, Guez, Silver 2016) of the dissertation.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from torch import Tensor
from torch.nn import functional

LossName = Literal["huber", "mse"]


class Batch(NamedTuple):
    """A minibatch of transitions.

    s_tm1 and s_t are `[batch, *shape]` float32, a_tm1 `[batch]` int64, r_t and discount_t `[batch]` float32. `weight`
    `[batch]` float32 are the importance weights of the losses, None if all are 1. `teacher` `[batch]` int64 are the
    actions of a teacher in s_tm1, `teacher_weight` `[batch]` float32 the weights of their losses; None without one.
    """

    s_tm1: Tensor
    a_tm1: Tensor
    r_t: Tensor
    discount_t: Tensor
    s_t: Tensor
    weight: Tensor | None = None
    teacher: Tensor | None = None
    teacher_weight: Tensor | None = None


OPTIONAL_COLUMNS = ("weight", "teacher", "teacher_weight")
"""Columns that only some super-batches have."""


def minibatch(columns: dict[str, Tensor], rows: slice) -> Batch:
    """One minibatch of the columns of a super-batch."""
    return Batch(
        columns["observation"][rows],
        columns["action"][rows],
        columns["reward"][rows],
        columns["discount"][rows],
        columns["next_observation"][rows],
        *(columns[name][rows] if name in columns else None for name in OPTIONAL_COLUMNS),
    )


def td_targets(q_t: Tensor, selector: Tensor, r_t: Tensor, discount_t: Tensor) -> Tensor:
    """R + discount * q_t(argmax_a selector(a)), `[batch]`.

    This is Double DQN (Algorithm 2) if the selector holds the online network's values, and DQN (Algorithm 1) if it is
    q_t itself: q_t at its own argmax is max_a q_t(a).

    Args:
      q_t: the target network's action values of the next state, `[batch, actions]`.
      selector: the action values that select the next action, `[batch, actions]`.
      r_t, discount_t: `[batch]`.
    """
    best = selector.argmax(dim=1, keepdim=True)
    return r_t + discount_t * q_t.gather(1, best).squeeze(1)


def mean_loss(
    q_tm1: Tensor, a_tm1: Tensor, target: Tensor, loss: LossName = "huber", weight: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Mean loss of the taken actions' values; no gradient flows into the targets.

    Args:
      q_tm1: action values `[batch, actions]`.
      a_tm1: taken actions `[batch]`.
      target: TD targets `[batch]`.
      loss: of a TD error d: "huber" is d^2 / 2 up to |d| = 1 and |d| - 1/2 beyond, "mse" is d^2.
      weight: importance weights of the losses `[batch]`, None for 1.

    Returns:
      (loss, TD errors `[batch]`, which are target - value, detached).
    """
    chosen = q_tm1.gather(1, a_tm1.unsqueeze(1)).squeeze(1)
    fixed = target.detach()
    function = functional.smooth_l1_loss if loss == "huber" else functional.mse_loss
    if weight is None:
        mean = function(chosen, fixed)
    else:
        mean = (weight * function(chosen, fixed, reduction="none")).mean()
    return mean, (fixed - chosen).detach()


def margin_losses(q_tm1: Tensor, teacher: Tensor, margin: float) -> tuple[Tensor, Tensor]:
    """max_a [q(a) + margin (a != teacher)] - q(teacher), `[batch]`: 0 once the teacher's action leads by the margin.

    Hester et al. (2018), Deep Q-learning from Demonstrations, Eq. 5.

    Args:
      q_tm1: action values `[batch, actions]`.
      teacher: actions of the teacher `[batch]`.
      margin: by how much their values shall exceed the others'.

    Returns:
      (losses, the actions of the maxima `[batch]`: the lowest index among equals).
    """
    raised = q_tm1.detach() + margin
    own = teacher.unsqueeze(1)
    rival = raised.scatter(1, own, raised.gather(1, own) - margin).argmax(dim=1)
    best, taught = (q_tm1.gather(1, action.unsqueeze(1)).squeeze(1) for action in (rival, teacher))
    return best - taught + margin * (rival != teacher), rival
