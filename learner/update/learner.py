"""The learner: online and target network, optimiser, and the update over a super-batch."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file
from safetensors.torch import save as to_bytes
from torch import Tensor

from actors.policy.network import snapshot
from actors.policy.policy import WeightsSnapshot
from actors.rollout.vector_env import EnvShape
from learner.config import RunConfig
from learner.update.adam import Adam
from learner.update.compiled_updates import CompiledUpdates
from learner.update.gradients import FlatNetwork
from learner.update.networks import learning_network
from learner.update.stats import UpdateStats
from learner.update.updates import TorchUpdates, Updates
from sim_core.checks import require

COLUMNS = ("reward", "discount", "action", "observation", "next_observation")
TEACHER_COLUMNS = ("teacher", "teacher_weight")
"""Columns that are there with a teacher."""
Rows = NDArray[Any] | dict[str, NDArray[Any]]
"""Transitions: rows of `actors.service.messages.transition_dtype`, or their columns by name."""


class Learner:
    """Owns the networks and the optimiser; every update is one gradient step of one minibatch.

    Args:
      config: the run.
      shape: spaces of its environment.

    Attributes:
      online, target: the networks.
      policy: the network that acts: the online network, or the moving average of its weights.
      optimiser: Adam over the online network's parameters.
      updates: made so far.
      td_errors: TD errors of the last call's rows, each before its update, `[rows]` float32.

    Raises:
      ConfigError: this machine has no such device.
    """

    def __init__(self, config: RunConfig, shape: EnvShape) -> None:
        torch.set_num_threads(1)
        with torch.random.fork_rng():
            torch.manual_seed(config.seed)
            online = learning_network(config, shape)
        self.device = learning_device(config.device)
        self._online = FlatNetwork(online.to(self.device))
        self._target = self._online.copy()
        self._average = self._online.copy() if config.policy_average_updates else None
        self._average_updates = config.policy_average_updates
        self.online, self.target = self._online.network, self._target.network
        self.policy = self.online if self._average is None else self._average.network
        self.optimiser = Adam(self._online.values)
        by_hand = config.gradients == "by_hand"
        compilable = by_hand and config.network != "dueling" and self.device.type == "cpu"
        kind = CompiledUpdates if compilable else TorchUpdates
        self._make_updates: Updates = kind(self._online, self._target, self.optimiser, config)
        self.updates = 0
        self._batch_size = config.batch_size
        self._columns = Columns()
        self.td_errors = np.zeros(0, np.float32)

    def update(self, rows: Rows, learning_rate: float, weights: NDArray[np.float32] | None = None) -> UpdateStats:
        """Makes one update per minibatch of `batch_size` rows.

        Args:
          rows: a super-batch of transitions (see Rows), a multiple of `batch_size`.
          learning_rate: Adam's.
          weights: importance weights of the rows' losses, `[rows]`, None for 1.
        """
        columns = self._columns(rows)
        if weights is not None:
            columns["weight"] = torch.from_numpy(weights)
        stats, self.td_errors = self._make_updates(columns, learning_rate, self.updates)
        updates = len(self.td_errors) // self._batch_size
        self.updates += updates
        if self._average is not None:
            self._average.values.data.lerp_(self._online.values.data, 1.0 - math.exp(-updates / self._average_updates))
        return stats

    def weights(self, time_s: float) -> WeightsSnapshot:
        """The policy's weights, published at `time_s`."""
        return snapshot(self.policy, self.updates, time_s)

    def get_state(self) -> dict[str, Tensor]:
        """A copy of all tensors that a checkpoint needs, by name."""
        state = {f"online.{name}": tensor for name, tensor in self.online.state_dict().items()}
        state |= {f"target.{name}": tensor for name, tensor in self.target.state_dict().items()}
        if self._average is not None:
            state |= {f"average.{name}": tensor for name, tensor in self.policy.state_dict().items()}
        state |= {f"optimiser.{name}": tensor for name, tensor in self.optimiser.state.items()}
        state["updates"] = torch.tensor(self.updates)
        return {name: tensor.detach().cpu().clone().contiguous() for name, tensor in state.items()}

    def state_writer(self) -> Callable[[Path], object]:
        """Copies the state; returns a call that writes it to a file.

        Raises:
          FloatingPointError: a number is not finite; the message names it.
        """
        tensors = self.get_state()
        for name, tensor in tensors.items():
            if not torch.isfinite(tensor).all():
                raise FloatingPointError(f"{name} is not finite")
        return lambda path: path.write_bytes(to_bytes(tensors))

    def read_state(self, path: Path) -> None:
        """Restores what `state_writer` wrote (see `set_state` for errors)."""
        self.set_state(load_file(str(path)))

    def set_state(self, state: dict[str, Tensor]) -> None:
        """Restores what `get_state` returned.

        Raises:
          ValueError: the tensors are those of a network of another shape.
        """
        try:
            self.online.load_state_dict(_with_prefix(state, "online."))
            self.target.load_state_dict(_with_prefix(state, "target."))
            if self._average is not None:
                self.policy.load_state_dict(_with_prefix(state, "average."))
            self.optimiser.set_state(_with_prefix(state, "optimiser."))
        except RuntimeError as error:
            raise ValueError(f"the saved networks have another shape: {str(error).splitlines()[-1].strip()}") from error
        self.updates = int(state["updates"])


def learning_device(name: Literal["auto", "cpu", "cuda"]) -> torch.device:
    """The device that the config's `device` means on this machine.

    Raises:
      ConfigError: it is CUDA, and this machine has none.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    require(
        name == "cpu" or torch.cuda.is_available(),
        "device is cuda, but PyTorch finds no CUDA device where the learner runs; give --device auto or cpu",
    )
    return torch.device(name)


def _with_prefix(state: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors whose names begin with `prefix`, under the rest of their names."""
    return {name.removeprefix(prefix): tensor for name, tensor in state.items() if name.startswith(prefix)}


class Columns:
    """Converts transitions to columns of tensors: observations, rewards and discounts float32, actions int64.

    A column that has its dtype already is not copied. The others are copied to buffers that all calls of the same
    number of rows share, so a call overwrites the tensors of the call before. A super-batch is megabytes; allocating
    them anew in every call would cost more than the copy.
    """

    def __init__(self) -> None:
        self._tensors: dict[str, Tensor] = {}

    def __call__(self, rows: Rows) -> dict[str, Tensor]:
        """The columns of `rows`, `[rows, ...]` each."""
        taught = TEACHER_COLUMNS if isinstance(rows, dict) and "teacher" in rows else ()
        return {name: self._column(name, rows[name]) for name in (*COLUMNS, *taught)}

    def _column(self, name: str, column: NDArray[Any]) -> Tensor:
        wanted = np.int64 if name in ("action", "teacher") else np.float32
        if column.dtype == wanted and column.flags.c_contiguous and column.flags.writeable:
            return torch.from_numpy(column)
        tensor = self._tensors.get(name)
        if tensor is None or tensor.shape != column.shape:
            tensor = self._tensors[name] = torch.from_numpy(np.empty(column.shape, wanted))
        np.copyto(tensor.numpy(), column, casting="unsafe")
        return tensor
