"""Loads what the end of a training over Ray needs while the training runs, in a thread of the driver.

The end draws a curve and exports the network, and both libraries take seconds to import. A driver over Ray mostly waits
for others, so it imports them meanwhile: in the second half, when the start no longer needs the cores.
"""

from __future__ import annotations

import importlib
import threading

from learner.tracking.journal import Row
from learner.tracking.observer import Display

MODULES = ("learner.tracking.mlflow_policy", "torch._dynamo", "deploy.runs.artifacts")
"""What the end imports; MLflow's export of a network loads PyTorch's compiler."""


class EndImports:
    """Passes everything on to a display, and imports `MODULES` once half of the env steps are done.

    Args:
      display: shows the run to the user.
      total_env_steps: env steps of the whole run.
    """

    def __init__(self, display: Display, total_env_steps: int) -> None:
        self._display = display
        self._half_env_steps = total_env_steps / 2
        self._has_begun = False

    def row(self, row: Row) -> None:
        """Shows the row; the first one of the second half begins the imports."""
        self._display.row(row)
        if row.env_steps >= self._half_env_steps and not self._has_begun:
            self._has_begun = True
            threading.Thread(target=_import_all, name="end-imports").start()

    def message(self, text: str) -> None:
        """Shows the message."""
        self._display.message(text)


def _import_all() -> None:
    for name in MODULES:
        importlib.import_module(name)
