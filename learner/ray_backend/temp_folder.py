"""The folder in which a Ray on this machine keeps its sockets and logs.

Ray takes TMPDIR, and paths of sockets have at most 107 bytes: where TMPDIR is long, or cannot be written to, a Ray of
our own gets a short folder of its own.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from sim_core.checks import ConfigError

SOCKET = "ray/session_2000-01-01_00-00-00_000000_0000000/sockets/plasma_store"
"""The longest path of a socket below TMPDIR."""
LONGEST = 100
"""Bytes of a socket's path, with some to spare for what Ray appends."""
SHORT = ("/tmp", "/var/tmp", "/dev/shm")
"""Folders for temporary files whose paths are short."""


def own_temp_folder() -> Path | None:
    """A new folder for a Ray on this machine, which the caller removes; None if the one that Ray takes will do.

    Raises:
      ConfigError: there is no folder that will do.
    """
    taken = os.environ.get("RAY_TMPDIR") or os.environ.get("TMPDIR") or SHORT[0]
    is_short = len(os.fsencode(Path(taken) / SOCKET)) <= LONGEST
    if is_short and _can_be_written(Path(taken)):
        return None
    for folder in SHORT:
        if _can_be_written(Path(folder)):
            return Path(tempfile.mkdtemp(prefix="shoal-ray-", dir=folder))
    raise ConfigError(
        f"Ray cannot keep its sockets in {taken}, whose path is too long or which cannot be written to, nor in "
        f"{', '.join(SHORT)}: set RAY_TMPDIR to a folder with a short path"
    )


def _can_be_written(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True
