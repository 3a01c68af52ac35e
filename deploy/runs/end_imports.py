"""Loads what the end of a training needs while the training runs.

The end draws a curve and exports the network, and the libraries take seconds to import. The process that writes to
MLflow exports the network, and loads what that takes. A driver over Ray mostly waits for others, so a thread of it
imports what draws. Both begin with the first row of metrics, when the start no longer needs the cores.
"""

from __future__ import annotations

import importlib
import threading

from learner.tracking.journal import Row
from learner.tracking.observer import Display
from learner.tracking.tracked_run import TrackedRun

DRAWS = "deploy.runs.artifacts"
"""The module that draws the curve, with Matplotlib."""


class EndImports:
    """Passes everything on to a display, and begins to load what the end needs once there is a row of metrics.

    Args:
      display: shows the run to the user.
      tracker: the run in MLflow.
      waits: whether this process mostly waits for others.
    """

    def __init__(self, display: Display, tracker: TrackedRun, waits: bool) -> None:
        self._display = display
        self._waits = waits
        self._tracker = tracker
        self._has_begun = False

    def row(self, row: Row) -> None:
        """Shows the row; the first one begins the imports."""
        self._display.row(row)
        if not self._has_begun:
            self._has_begun = True
            self._tracker.load_end()
            if self._waits:
                threading.Thread(target=importlib.import_module, args=(DRAWS,), name="end-imports").start()

    def message(self, text: str) -> None:
        """Shows the message."""
        self._display.message(text)
