"""What shoal's own processes have in common: how one is started, and what stops a run. Imports next to nothing."""

from __future__ import annotations

import gc
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that stop a run; SIGHUP comes from a terminal that is closed, or a connection that is lost."""


def collect_rarely() -> None:
    """Has Python look for cycles less often: what imports make stays, and to look through it takes a tenth of them."""
    gc.set_threshold(100_000, 20, 20)


def module_order(module: str, arguments: Sequence[str]) -> list[str]:
    """The command line that runs one of shoal's modules, of the same shoal as this process runs.

    `-m` alone would prefer what the current folder has of the same name; a process that began so goes on so.
    """
    is_here = not sys.flags.safe_path and Path(sys.path[0]).resolve() == Path.cwd()  # as `python -m` has it
    return [sys.executable, *(["-m"] if is_here else ["-P", "-m"]), module, *arguments]
