"""The command line of a process that runs one of shoal's own modules. Imports next to nothing."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path


def module_order(module: str, arguments: Sequence[str]) -> list[str]:
    """The command line that runs one of shoal's modules, of the same shoal as this process runs.

    `-m` alone would prefer what the current folder has of the same name; a process that began so goes on so.
    """
    is_here = not sys.flags.safe_path and Path(sys.path[0]).resolve() == Path.cwd()  # as `python -m` has it
    return [sys.executable, *(["-m"] if is_here else ["-P", "-m"]), module, *arguments]
