"""What is said of files of another user."""

from __future__ import annotations

from pathlib import Path


def may_not_read(path: Path | str) -> str:
    """The sentence on a file that may not be read."""
    return f"{path} may not be read by you; ask its owner for the right to read it, or for a copy"


def may_not_write(path: Path | str) -> str:
    """The sentence on a folder that may not be written to."""
    return f"{path} may not be written to by you; copy it to a folder of yours, or ask its owner for the right to write"
