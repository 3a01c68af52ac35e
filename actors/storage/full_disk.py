"""Recognises a full disk in the errors of everything that writes: files, formats, databases and other processes."""

from __future__ import annotations

import errno
import os

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""What a write to a full disk, beyond a quota, or beyond a process's limit on files (`ulimit -f`) fails with."""
DISK_TIMEOUT_S = 600.0
"""How long a run that is about to end waits for space."""
_TEXTS = (*map(os.strerror, FULL), "database or disk is full")
"""How libraries that raise errors of their own name it; the last is SQLite's."""


def is_full(text: str) -> bool:
    """Whether an error's text says that the disk is full."""
    return any(each in text for each in _TEXTS)


def is_disk_full(error: BaseException | None) -> bool:
    """Whether the error, or one that led to it, is that of a full disk."""
    while error is not None:
        if getattr(error, "errno", None) in FULL or is_full(str(error)):
            return True
        error = error.__cause__ or error.__context__
    return False
