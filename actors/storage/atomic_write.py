"""Atomic replacement on a local disk: a reader of a path finds the old content or the new one, never half of either.

New content is written beside its place, under a name that ends in `.part`, and renamed once it is whole. A crash leaves
the old content and perhaps a `.part`: the next write replaces it, or pruning removes it where its name is random.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def replacing_file(path: Path, *, sync_first: bool = False) -> Iterator[Path]:
    """Gives a path to write a file to, which replaces the file at `path` once the `with` block ends without an error.

    Args:
      path: the file's place; its folder exists.
      sync_first: fsync the content before the rename, so that a power cut cannot leave an empty file at `path`.
    """
    partial = _beside(path, ".part")
    try:
        yield partial
        if sync_first:
            sync(partial)
        partial.replace(path)
    except BaseException:
        with suppress(OSError):
            partial.unlink()
        raise


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Gives a path to make a folder at, which replaces the one at `path` once the `with` block ends without an error.

    What the folder holds is not synced.

    Args:
      path: the folder's place.
    """
    partial = _beside(path, ".part")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        yield partial
        replace_folder(partial, path)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def replace_folder(new: Path, path: Path) -> None:
    """Renames the folder `new` to `path`, and makes the rename durable.

    A rename cannot replace a folder that holds something: an older one at `path` becomes `path.old`, and is removed
    once the new one is in its place. A crash between the two renames leaves it as `path.old`.
    """
    old = _beside(path, ".old")
    if path.exists():
        shutil.rmtree(old, ignore_errors=True)
        path.rename(old)
    new.rename(path)
    sync(path.parent)
    shutil.rmtree(old, ignore_errors=True)


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)


def sync(path: Path) -> None:
    """Makes the content of a file, or the entries of a folder, durable (fsync)."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_all(path: Path) -> None:
    """Makes a file, or a folder with everything in it, durable; the caller syncs the parent folder."""
    for each in [path, *path.rglob("*")] if path.is_dir() else [path]:
        sync(each)
