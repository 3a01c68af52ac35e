"""The updates of a super-batch, one gradient step a minibatch, by PyTorch on whatever device it has."""

from __future__ import annotations

from typing import Literal, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.update.double_dqn import LossName, as_batch
from learner.update.gradients import GRADIENTS, FlatNetwork


class LearnerSettings(NamedTuple):
    """What the learner needs to know of the run.

    With a `soft_target_rate` the target network follows the online network after every update (Polyak's average),
    without one it is copied every `target_update_interval`.
    """

    observation_size: int
    num_actions: int
    hidden_sizes: tuple[int, ...]
    double: bool
    batch_size: int
    target_update_interval: int
    max_gradient_norm: float
    gradients: Literal["by_hand", "autograd"]
    seed: int
    network: Literal["plain", "dueling"]
    loss: LossName
    soft_target_rate: float | None
    device: Literal["auto", "cpu", "cuda"]


class UpdateStats(NamedTuple):
    """Means over the updates of one call."""

    loss: float
    q_mean: float
    td_error: float


class Updates(Protocol):
    """How the updates of a call are made."""

    def __call__(
        self, columns: dict[str, Tensor], learning_rate: float, updates: int
    ) -> tuple[UpdateStats, NDArray[np.float32]]:
        """One update per `batch_size` rows, a whole multiple of it.

        Args:
          columns: of the packed transitions, `[rows, ...]` on the CPU; `weight` where losses do not count alike.
          learning_rate: Adam's.
          updates: made before this call.

        Returns:
          (means, TD errors `[rows]`, each before its update).
        """
        ...


class TorchUpdates:
    """Updates by PyTorch (see `Updates`).

    Args:
      online, target: the networks, whose memory is changed.
      optimiser: over the online network's flat parameters.
      settings: of the learner.
    """

    def __init__(
        self, online: FlatNetwork, target: FlatNetwork, optimiser: torch.optim.Adam, settings: LearnerSettings
    ) -> None:
        self._online, self._target, self._optimiser, self._settings = online, target, optimiser, settings
        self._gradients = GRADIENTS[settings.gradients](online, target, settings.double, settings.loss)

    def __call__(
        self, columns: dict[str, Tensor], learning_rate: float, updates: int
    ) -> tuple[UpdateStats, NDArray[np.float32]]:
        """See `Updates`."""
        for group in self._optimiser.param_groups:
            group["lr"] = learning_rate
        device, size = self._online.values.device, self._settings.batch_size
        columns = {name: column.to(device) for name, column in columns.items()}
        sums, errors = torch.zeros(3, device=device), torch.empty(len(columns["action"]), device=device)
        starts = range(0, len(errors), size)
        for number, start in enumerate(starts, updates + 1):
            part = slice(start, start + size)
            *means, errors[part] = self._gradients(as_batch(columns, part))
            sums += torch.stack(means)
            self._online.clip_gradients(self._settings.max_gradient_norm)
            self._optimiser.step()
            self._update_target(number)
        return UpdateStats(*(sums / len(starts)).tolist()), errors.cpu().numpy()

    def _update_target(self, number: int) -> None:
        online, target, rate = self._online.values.data, self._target.values.data, self._settings.soft_target_rate
        if rate is not None:
            target.lerp_(online, rate)
        elif number % self._settings.target_update_interval == 0:
            target.copy_(online)
