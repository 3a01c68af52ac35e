"""Checkpoints: folders that are whole or not there, with a checksum of every file.

A checkpoint is written under another name, its manifest last, every file is synced, and only then is the
folder renamed into place. A reader trusts nothing that its manifest does not vouch for.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from sim_core.checks import ConfigError

FORMAT = "shoal-checkpoint-3"
MANIFEST = "manifest.json"
STATE = "state.json"
PREFIX = "step-"


class CheckpointError(ConfigError):
    """A checkpoint that cannot be used; the message says why."""


class Checkpoint(NamedTuple):
    """A verified checkpoint: its folder and the state of `state.json`."""

    folder: Path
    state: dict[str, Any]


def write_checkpoint(root: Path, env_steps: int, save_parts: Callable[[Path], dict[str, Any]]) -> Path:
    """Writes one checkpoint.

    Args:
      root: folder of the run's checkpoints.
      env_steps: env steps so far; names the checkpoint.
      save_parts: writes the parts' files into the folder it is given and returns the rest of the state.

    Returns:
      The checkpoint's folder; an older one of the same step has been replaced.
    """
    root.mkdir(parents=True, exist_ok=True)
    final = root / f"{PREFIX}{env_steps:012d}"
    part = final.with_name(final.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    state = save_parts(part)
    (part / STATE).write_text(json.dumps(state))
    files = sorted(path for path in part.rglob("*") if path.is_file())
    sums = {str(path.relative_to(part)): _sha256(path) for path in files}
    (part / MANIFEST).write_text(json.dumps({"format": FORMAT, "env_steps": env_steps, "sha256": sums}))
    _sync(part)
    old = final.with_name(final.name + ".old")
    if final.exists():
        shutil.rmtree(old, ignore_errors=True)
        final.rename(old)  # after a crash between here and the next line it still counts
    part.rename(final)
    _sync_folder(root)
    shutil.rmtree(old, ignore_errors=True)
    return final


def keep_newest(root: Path, count: int) -> None:
    """Removes all but the `count` newest checkpoints, and what crashed writers left."""
    for left in set(root.glob(f"{PREFIX}*")) - set(finished_folders(root)):
        shutil.rmtree(left, ignore_errors=True)
    for old in finished_folders(root)[count:]:
        shutil.rmtree(old, ignore_errors=True)


def read_checkpoint(folder: Path) -> Checkpoint:
    """Verifies every file of a checkpoint and reads its state.

    Raises:
      CheckpointError: it is missing, incomplete, damaged, or of another format.
    """
    if not folder.is_dir():
        raise CheckpointError(f"there is no checkpoint {folder}; name a run or a folder under its checkpoints")
    try:
        manifest = json.loads((folder / MANIFEST).read_text())
        found = manifest["format"]
        sums: dict[str, str] = manifest["sha256"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(
            f"checkpoint {folder} has no readable manifest; use an older one or train anew"
        ) from error
    if found != FORMAT:
        raise CheckpointError(f"checkpoint {folder} is in format {found!r}, this version reads {FORMAT}")
    if not isinstance(sums, dict) or STATE not in sums:
        raise CheckpointError(f"checkpoint {folder} is damaged ({MANIFEST}); use an older one or train anew")
    for name, expected in sums.items():
        path = folder / name
        if not path.is_file() or _sha256(path) != expected:
            raise CheckpointError(f"checkpoint {folder} is damaged ({name}); use an older one or train anew")
    return Checkpoint(folder, json.loads((folder / STATE).read_text()))


def newest_valid(root: Path) -> tuple[Checkpoint, list[str]]:
    """The newest checkpoint that passes, and why newer ones were skipped.

    Raises:
      CheckpointError: there is none.
    """
    skipped: list[str] = []
    for folder in finished_folders(root):
        try:
            return read_checkpoint(folder), skipped
        except CheckpointError as error:
            skipped.append(str(error))
    reason = f": {skipped[0]}" if skipped else ""
    raise CheckpointError(f"no usable checkpoint in {root}{reason}")


def finished_folders(root: Path) -> list[Path]:
    """Finished checkpoints, newest first; one that was being replaced counts until its successor is in place."""
    names = (path for path in root.glob(f"{PREFIX}*") if path.is_dir() and path.suffix != ".part")
    return sorted((path for path in names if not (path.suffix and path.with_suffix("").exists())), reverse=True)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sync(folder: Path) -> None:
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb") as file:
                os.fsync(file.fileno())
        else:
            _sync_folder(path)
    _sync_folder(folder)


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
