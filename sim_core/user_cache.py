"""The folder in which shoal keeps what a user's processes need not make again. Imports next to nothing."""

from __future__ import annotations

import os
from pathlib import Path


def user_cache() -> Path | None:
    """The folder, which need not exist (XDG Base Directory Specification); None for a user without a home."""
    chosen = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    return chosen / "shoal" if chosen.is_absolute() else None  # a user without a home has `~`
