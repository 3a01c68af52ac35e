"""The updates of a call, one gradient step per minibatch; here by PyTorch, on whatever device it has."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.config import RunConfig
from learner.update.adam import Adam
from learner.update.double_dqn import minibatch
from learner.update.gradients import GRADIENTS, FlatNetwork
from learner.update.stats import UpdateStats


class Updates(Protocol):
    """How the updates of a call are made."""

    def __call__(
        self, columns: dict[str, Tensor], learning_rate: float, updates: int
    ) -> tuple[UpdateStats, NDArray[np.float32]]:
        """One update per minibatch of `batch_size` rows.

        Args:
          columns: of a super-batch, `[rows, ...]` on the CPU; rows is a multiple of `batch_size`. `weight` is missing
            where all importance weights are 1, `teacher` and `teacher_weight` where there is no teacher.
          learning_rate: Adam's.
          updates: made before this call.

        Returns:
          (means, TD errors `[rows]`, each before its update).
        """
        ...


class TorchUpdates:
    """Updates by PyTorch (see `Updates`).

    Args:
      online, target: the networks; their memory is changed in place.
      optimiser: over the online network's flat parameters.
      config: of the run.
    """

    def __init__(self, online: FlatNetwork, target: FlatNetwork, optimiser: Adam, config: RunConfig) -> None:
        self._online, self._target, self._optimiser, self._config = online, target, optimiser, config
        double = config.algorithm == "double_dqn"
        kind = "autograd" if config.network == "pooled" else config.gradients  # by hand only in compiled updates
        self._gradients = GRADIENTS[kind](online, target, double, config.loss, config.teacher_margin)

    def __call__(
        self, columns: dict[str, Tensor], learning_rate: float, updates: int
    ) -> tuple[UpdateStats, NDArray[np.float32]]:
        """See `Updates`."""
        device, size = self._online.values.device, self._config.batch_size
        columns = {name: column.to(device) for name, column in columns.items()}
        sums, td_errors = torch.zeros(3, device=device), torch.empty(len(columns["action"]), device=device)
        starts = range(0, len(td_errors), size)
        for update, start in enumerate(starts, updates + 1):
            rows = slice(start, start + size)
            *means, td_errors[rows] = self._gradients(minibatch(columns, rows))
            sums += torch.stack(means)
            self._online.clip_gradients(self._config.max_gradient_norm)
            self._optimiser.step(learning_rate)
            self._update_target(update)
        return UpdateStats(*(sums / len(starts)).tolist()), td_errors.cpu().numpy()

    def _update_target(self, update: int) -> None:
        online, target, config = self._online.values.data, self._target.values.data, self._config
        if config.target_update == "soft":
            target.lerp_(online, config.target_update_rate)
        elif update % config.target_update_interval == 0:
            target.copy_(online)
