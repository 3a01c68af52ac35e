"""Where a run's checkpoints lie: a folder, where a rename completes one, or an fsspec URL, where its manifest does.

Both list, read, complete and remove; neither knows what a checkpoint holds.
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
OURS = re.compile(r"step-\d{12,18}(\.|$)")
NAME = re.compile(r"step-(\d{12,18})(?:\.(\d{1,9}|old))?")


class OpenFile(NamedTuple):
    """An open file and its length in bytes."""

    file: BinaryIO
    size: int


class CheckpointStore(Protocol):
    """A run's checkpoints, by name; every method may raise OSError."""

    def names(self) -> list[str]:
        """Names of finished checkpoints, newest first."""
        ...

    def location(self, name: str) -> Location:
        """Where a checkpoint's files lie."""
        ...

    def open(self, name: str, file: str) -> OpenFile:
        """Opens one file of a checkpoint; whatever is no plain file of its folder is refused with an OSError."""
        ...

    def draft(self, env_steps: int) -> Location:
        """Where the files of a new checkpoint are to be written before `complete`; asks no storage.

        No two drafts are in one place, so that a part that was given up while it wrote cannot spoil the next one.
        """
        ...

    def complete(self, draft: Location, last: dict[str, bytes]) -> str:
        """Adds small files in order, the manifest last, and makes the draft a checkpoint; returns its name."""
        ...

    def remove(self, names: list[str]) -> None:
        """Removes checkpoints, and drafts that nobody completed."""
        ...


def env_steps_of(name: str) -> int:
    """Env steps that a checkpoint's name says."""
    match = NAME.fullmatch(name)
    assert match is not None
    return int(match[1])


def _age(name: str) -> tuple[int, int]:
    """Sorts names from the oldest to the newest: by env steps, then by how often that name had been taken."""
    match = NAME.fullmatch(name)
    assert match is not None
    return int(match[1]), -1 if match[2] == "old" else int(match[2] or 0)


def open_store(root: Location) -> CheckpointStore:
    """The checkpoints at a location.

    Raises:
      ConfigError: nothing here speaks the URL's protocol.
      OSError: the storage does not answer.
    """
    return FolderStore(root) if isinstance(root, Path) else UrlStore(root)


class FolderStore:
    """Checkpoints in a folder; implements CheckpointStore. A draft has another name until it is whole and synced."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def names(self) -> list[str]:
        """Finished ones; one that was being replaced (`.old`) counts until its successor is in place."""
        found = [path.name for path in self._root.glob(f"{PREFIX}*") if NAME.fullmatch(path.name) and path.is_dir()]
        kept = (name for name in found if not name.endswith(".old") or name.removesuffix(".old") not in found)
        return sorted(kept, key=_age, reverse=True)

    def location(self, name: str) -> Path:
        """The checkpoint's folder."""
        return self._root / name

    def open(self, name: str, file: str) -> OpenFile:
        """Opens a file, unless it or a folder on the way to it is a link, or it is no regular file."""
        path = self._root
        for part in (name, *file.split("/")):
            path = path / part
            if path.is_symlink():
                raise OSError(f"{path} is a link")
        if not stat.S_ISREG(path.stat().st_mode):
            raise OSError(f"{path} is no plain file")
        opened = path.open("rb")
        return OpenFile(opened, os.fstat(opened.fileno()).st_size)

    def draft(self, env_steps: int) -> Path:
        """The final name, something random and `.part`."""
        return self._root / f"{PREFIX}{env_steps:012d}.{uuid.uuid4().hex[:8]}.part"

    def complete(self, draft: Location, last: dict[str, bytes]) -> str:
        """Syncs the small files and the folders, then renames; an older one of the same name is replaced."""
        assert isinstance(draft, Path)
        for name, content in last.items():
            (draft / name).write_bytes(content)
            sync(draft / name)
        sync(draft)
        final = self._root / draft.name.split(".")[0]
        replace_folder(draft, final)  # `names` counts a `.old` that a crash leaves
        return final.name

    def remove(self, names: list[str]) -> None:
        """Removes folders, and all that is neither finished nor to be kept."""
        finished = set(self.names())
        left = [path for path in self._root.glob(f"{PREFIX}*") if OURS.match(path.name) and path.name not in finished]
        for path in [*left, *(self._root / name for name in names)]:
            shutil.rmtree(path, ignore_errors=True)


class UrlStore:
    """Checkpoints under an fsspec URL; implements CheckpointStore. What has no manifest does not count.

    Files are never written over: a name that is taken gets a number.
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
        parts = [name.split("/") for name in self._find()]
        found = {part[0] for part in parts if len(part) == 2 and part[1] == MANIFEST and NAME.fullmatch(part[0])}
        return sorted(found, key=_age, reverse=True)

    def location(self, name: str) -> str:
        """The checkpoint's URL."""
        return f"{self._url}/{name}"

    def open(self, name: str, file: str) -> OpenFile:
        """Opens a file."""
        with storage_errors(self._url):
            opened = self._files.open(f"{self._path}/{name}/{file}", "rb")
            return OpenFile(opened, int(opened.size))

    def draft(self, env_steps: int) -> str:
        """The first name of these env steps that is not taken."""
        base = name = f"{PREFIX}{env_steps:012d}"
        number = 0
        while name in self._taken:
            number += 1
            name = f"{base}.{number}"
        self._taken.add(name)
        return f"{self._url}/{name}"

    def complete(self, draft: Location, last: dict[str, bytes]) -> str:
        """Writes the small files, one after the other."""
        name = str(draft).rsplit("/", 1)[1]
        with storage_errors(draft):
            for file, content in last.items():
                self._files.pipe_file(f"{self._path}/{name}/{file}", content)
        return name

    def remove(self, names: list[str]) -> None:
        """Removes manifests first, so that a crash leaves nothing that half counts."""
        found = self._find()
        finished = {name.split("/")[0] for name in found if name.endswith(f"/{MANIFEST}")}
        ours = [name for name in found if OURS.match(name.split("/")[0])]
        gone = [name for name in ours if name.split("/")[0] in names or name.split("/")[0] not in finished]
        with storage_errors(self._url):
            for name in sorted(gone, key=lambda name: not name.endswith(f"/{MANIFEST}")):
                self._files.rm_file(f"{self._path}/{name}")
