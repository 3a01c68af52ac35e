"""The storage of a run's checkpoints: a folder, where a rename commits one, or an fsspec URL, where its manifest does.

Both stores list, open, commit and remove checkpoints; neither knows what a checkpoint holds.
"""

from __future__ import annotations

import os
import re
import shutil
import stat
import uuid
from pathlib import Path
from typing import BinaryIO, NamedTuple, Protocol

from actors.storage.atomic_write import replace_folder, sync
from actors.storage.uri import Location, filesystem, storage_errors
from learner.checkpoints.manifest import MANIFEST

PREFIX = "step-"
NAME = re.compile(r"step-(\d{12,18})(?:\.(\d{1,9}|old))?")
"""Name of a checkpoint: env steps, then a number where the name was taken, or `old` (see `replace_folder`)."""
NAME_OR_DRAFT = re.compile(r"step-\d{12,18}(\.|$)")
"""Beginning of the names of checkpoints and drafts; everything else at the location belongs to somebody else."""


class OpenFile(NamedTuple):
    """An open file and its length in bytes."""

    file: BinaryIO
    size: int


class CheckpointStore(Protocol):
    """A run's checkpoints by name; every method but `location` and `draft` may raise OSError."""

    def names(self) -> list[str]:
        """Names of committed checkpoints, newest first."""
        ...

    def location(self, name: str) -> Location:
        """Location of a checkpoint's files."""
        ...

    def open(self, name: str, file: str) -> OpenFile:
        """Opens a file of a checkpoint; raises OSError unless it is a regular file in the checkpoint's own folder."""
        ...

    def draft(self, env_steps: int) -> Location:
        """Location for the fragments of a new checkpoint, before `commit`; does not access the storage.

        Every draft has a location of its own: a component that still writes an abandoned draft cannot spoil the next.
        """
        ...

    def commit(self, draft: Location, small_files: dict[str, bytes]) -> str:
        """Adds `small_files` in order, the manifest last, and makes the draft a checkpoint; returns its name."""
        ...

    def remove(self, names: list[str]) -> None:
        """Removes checkpoints, and all drafts."""
        ...


def env_steps_of(name: str) -> int:
    """Env steps in a checkpoint's name."""
    match = NAME.fullmatch(name)
    assert match is not None
    return int(match[1])


def _by_age(name: str) -> tuple[int, int]:
    """Sort key, oldest first: env steps, then the number behind a name that was taken; `.old` before all of them."""
    match = NAME.fullmatch(name)
    assert match is not None
    return int(match[1]), -1 if match[2] == "old" else int(match[2] or 0)


def open_store(root: Location) -> CheckpointStore:
    """The store of the checkpoints at `root`.

    Raises:
      ConfigError: no installed package handles the URL's protocol.
      OSError: the storage does not answer.
    """
    return FolderStore(root) if isinstance(root, Path) else UrlStore(root)


class FolderStore:
    """Checkpoints in a folder; implements CheckpointStore.

    A draft gets the name of a checkpoint by a rename, after everything in it has been synced.
    """

    def __init__(self, root: Path) -> None:
        self._root = root

    def names(self) -> list[str]:
        """Committed ones; a checkpoint that was being replaced (`.old`) counts until its successor has its name."""
        there = os.listdir(self._root) if self._root.is_dir() else []  # raises where it may not be listed
        found = [name for name in there if NAME.fullmatch(name) and (self._root / name).is_dir()]
        valid = (name for name in found if not name.endswith(".old") or name.removesuffix(".old") not in found)
        return sorted(valid, key=_by_age, reverse=True)

    def location(self, name: str) -> Path:
        """The checkpoint's folder."""
        return self._root / name

    def open(self, name: str, file: str) -> OpenFile:
        """Opens a regular file; refuses one that is a link, or whose path in the checkpoint contains a link."""
        path = self._root
        for segment in (name, *file.split("/")):
            path = path / segment
            if path.is_symlink():
                raise OSError(f"{path} is a link")
        if not stat.S_ISREG(path.stat().st_mode):
            raise OSError(f"{path} is not a regular file")
        opened = path.open("rb")
        return OpenFile(opened, os.fstat(opened.fileno()).st_size)

    def draft(self, env_steps: int) -> Path:
        """The final name, a random text and `.part`."""
        return self._root / f"{PREFIX}{env_steps:012d}.{uuid.uuid4().hex[:8]}.part"

    def commit(self, draft: Location, small_files: dict[str, bytes]) -> str:
        """Writes and syncs the small files, then renames the draft; an older checkpoint of that name is replaced."""
        assert isinstance(draft, Path)
        for name, content in small_files.items():
            (draft / name).write_bytes(content)
            sync(draft / name)
        sync(draft)
        final = self._root / draft.name.split(".")[0]
        replace_folder(draft, final)  # `names` counts the `.old` that a crash in here leaves
        return final.name

    def remove(self, names: list[str]) -> None:
        """Removes the folders of checkpoints and of all drafts."""
        committed, found = set(self.names()), self._root.glob(f"{PREFIX}*")
        drafts = [path for path in found if NAME_OR_DRAFT.match(path.name) and path.name not in committed]
        for path in [*drafts, *(self._root / name for name in names)]:
            shutil.rmtree(path, ignore_errors=True)


class UrlStore:
    """Checkpoints under an fsspec URL; implements CheckpointStore.

    A draft has the name of a checkpoint from the beginning, and becomes one when its manifest is written. Files are
    never overwritten: where a name is taken, a number is added to it.
    """

    def __init__(self, url: str) -> None:
        self._url = url
        with storage_errors(url):
            self._files, self._path = filesystem(url)
        self._taken = {name.split("/", 1)[0] for name in self._find()}

    def _find(self) -> list[str]:
        """Names of all files under the URL, relative to it."""
        with storage_errors(self._url):
            found: list[str] = self._files.find(self._path)
        return [name.removeprefix(self._path).lstrip("/") for name in found]

    def names(self) -> list[str]:
        """Those with a manifest."""
        paths = [name.split("/") for name in self._find()]
        found = {path[0] for path in paths if len(path) == 2 and path[1] == MANIFEST and NAME.fullmatch(path[0])}
        return sorted(found, key=_by_age, reverse=True)

    def location(self, name: str) -> str:
        """The checkpoint's URL."""
        return f"{self._url}/{name}"

    def open(self, name: str, file: str) -> OpenFile:
        """Opens a file."""
        with storage_errors(self._url):
            opened = self._files.open(f"{self._path}/{name}/{file}", "rb")
            return OpenFile(opened, int(opened.size))

    def draft(self, env_steps: int) -> str:
        """The first name for these env steps that is not taken."""
        base = name = f"{PREFIX}{env_steps:012d}"
        number = 0
        while name in self._taken:
            number += 1
            name = f"{base}.{number}"
        self._taken.add(name)
        return f"{self._url}/{name}"

    def commit(self, draft: Location, small_files: dict[str, bytes]) -> str:
        """Writes the small files, one after the other."""
        name = str(draft).rsplit("/", 1)[1]
        with storage_errors(draft):
            for file, content in small_files.items():
                self._files.pipe_file(f"{self._path}/{name}/{file}", content)
        return name

    def remove(self, names: list[str]) -> None:
        """Removes manifests first: what a crash leaves is a draft."""
        found = self._find()
        committed = {name.split("/")[0] for name in found if name.endswith(f"/{MANIFEST}")}
        ours = [name for name in found if NAME_OR_DRAFT.match(name.split("/")[0])]
        removed = [name for name in ours if name.split("/")[0] in names or name.split("/")[0] not in committed]
        with storage_errors(self._url):
            for name in sorted(removed, key=lambda name: not name.endswith(f"/{MANIFEST}")):
                self._files.rm_file(f"{self._path}/{name}")
