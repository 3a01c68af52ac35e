"""Where compiled kernels are kept on disk: one folder for each content of the sources, shared by all copies of them.

Numba caches a compiled kernel beside its own file and compiles it again when that file changes. It does not notice
changes in other files, so a kernel that inlines kernels of another file would keep their old code; and a copy of the
sources, such as the one that Ray makes for a job, would compile all of them again. Here the folder is named after a
hash of all sources that can hold kernels: every file of this package and every file of `KERNEL_PACKAGES` that imports
`sim_core.jit`, subfolders included. A change in any of them starts an empty folder, and equal sources share one,
wherever they lie. The sources in `__pycache__` do not count: they are copies of users' own methods and scenes
(`sim_core.plugins`).

A cache is no reason to fail: what cannot be read is compiled, and what cannot be saved is used without.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import io
import os
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, _CacheLocator

from sim_core.user_cache import user_cache

KERNEL_PACKAGES = ("actors", "learner")
"""The other packages with kernels. They lie beside this one."""
ANOTHER = "NUMBA_CACHE_DIR names another folder"
UNUSED_S = 30 * 86_400.0
"""Kernels of other sources that no process has loaded for so long are removed."""


def sources_digest() -> str:
    """Hash of all sources that can hold kernels, and of numba's version; 16 hex digits."""
    package = Path(__file__).parent
    digest = hashlib.sha256(numba.__version__.encode())
    for folder in (package, *(package.parent / name for name in KERNEL_PACKAGES)):
        for source in sorted(folder.rglob("*.py")):
            name, content = source.relative_to(package.parent), source.read_bytes()
            if "__pycache__" not in name.parts and (folder == package or b"sim_core.jit" in content):
                digest.update(str(name).encode() + b"\0" + content)
    return digest.hexdigest()[:16]


def _bases() -> list[Path]:
    """Folders that may hold compiled kernels, the preferred one first."""
    named = [Path(numba.config.CACHE_DIR)] if numba.config.CACHE_DIR else []
    users = user_cache()
    return [*named, *([users] if users else []), Path(__file__).parent / "__pycache__"]


def _is_usable(folder: Path) -> bool:
    """Whether the folder is there, or could be made, and takes files; others that nobody used for long are removed."""
    try:
        if not folder.exists():
            folder.mkdir(parents=True, exist_ok=True)
            _remove_unused(folder.parent)
        tempfile.TemporaryFile(dir=folder).close()
        os.utime(folder)
    except OSError:
        return False
    return True


def _remove_unused(base: Path) -> None:
    for folder in base.glob("kernels-*"):
        if folder.stat().st_mtime < time.time() - UNUSED_S:
            shutil.rmtree(folder, ignore_errors=True)


def cache_folder() -> str:
    """Folder of the kernels that were compiled from the present sources, which it makes.

    It lies in numba's own NUMBA_CACHE_DIR where that is set, else in the user's cache folder, else beside the sources,
    else in a folder for temporary files, which is said: the first that can be written. If there is none, the folder
    that is returned cannot be written: kernels are used without it, which is said as well.
    """
    name, bases = f"kernels-{sources_digest()}", _bases()
    for base in bases:
        if _is_usable(base / name):
            return str(base / name)
    temporary = _temporary_folder()
    is_new = temporary is not None and not (temporary / name).exists()
    if temporary is None or not _is_usable(temporary / name):
        return str(bases[0] / name)
    if is_new:
        tried = " nor ".join(str(base) for base in bases)
        _say(f"compiled kernels are kept in {temporary}, since neither {tried} can be written; {ANOTHER}")
    return str(temporary / name)


def _temporary_folder() -> Path | None:
    """This user's own folder for temporary files; None if there is none, or others could write code to it."""
    try:
        folder = Path(tempfile.gettempdir()) / f"shoal-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError:
        return None
    is_own = stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o022
    return folder if is_own else None


@functools.cache
def _say(text: str) -> None:
    """Says a sentence, once in this process."""
    print(text, file=sys.stderr)


CACHE_FOLDER = cache_folder()
"""The folder of this version's compiled kernels."""


class _ContentLocator(_CacheLocator):  # type: ignore[misc]
    """Says to numba that all kernels lie in `CACHE_FOLDER` and are never stale there."""

    def __init__(self, function: Any, file: str) -> None:
        self._module, self._py_file = function.__module__, file

    @classmethod
    def from_function(cls, function: Any, file: str) -> _ContentLocator:
        return cls(function, file)

    def get_cache_path(self) -> str:
        return CACHE_FOLDER

    def get_source_stamp(self) -> int:
        return 0

    def get_disambiguator(self) -> str:
        return hashlib.sha256(self._module.encode()).hexdigest()[:10]

    def ensure_cache_path(self) -> None:
        """Nothing: a kernel that cannot be saved is used without."""


class _CacheImpl(CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes = [_ContentLocator]

    def get_filename_base(self, fullname: str, abiflags: str) -> str:
        """Numba's, and the line: a file may hold two functions of one name."""
        return f"{super().get_filename_base(fullname, abiflags)}-{self._lineno}"


class CheckedCacheFile(IndexDataCacheFile):  # type: ignore[misc]
    """The cached signatures of one kernel, which several processes may save at once, in files that end in a checksum.

    Numba's own class locks nothing: two processes that save different signatures can choose the same file name, and a
    third one then loads the code of the wrong signature. Nor does it check anything: it runs what a file holds in
    which a bit has changed.
    """

    def save(self, key: Any, data: Any) -> None:
        """Saves the code of one signature, unless the disk takes nothing, which is said."""
        try:
            with open(f"{self._index_path}.lock", "w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                super().save(key, data)
        except OSError as error:
            reason = error.strerror or error
            _say(
                f"compiled kernels cannot be kept in {CACHE_FOLDER} ({reason}), so every start compiles them; {ANOTHER}"
            )

    def forget(self) -> None:
        """Removes the index, so that all signatures are compiled anew."""
        with contextlib.suppress(OSError):
            os.remove(self._index_path)

    @contextlib.contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[io.BytesIO]:
        content = io.BytesIO()
        yield content
        with super()._open_for_write(filepath) as file:
            file.write(content.getvalue() + hashlib.sha256(content.getvalue()).digest())

    def _load_index(self) -> Any:
        """Numba's index; one that is missing or damaged counts as empty."""
        return super()._load_index() if _is_whole(self._index_path) else {}

    def _load_data(self, name: str) -> Any:
        """The code of one signature; for numba, a damaged file is one that cannot be opened."""
        if not _is_whole(self._data_path(name)):
            raise OSError(f"{name} is damaged")
        return super()._load_data(name)


def _is_whole(path: str) -> bool:
    """Whether a file is there and ends in the checksum of what stands before it."""
    try:
        content = Path(path).read_bytes()
    except OSError:
        return False
    size = hashlib.sha256().digest_size
    return hashlib.sha256(content[:-size]).digest() == content[-size:]


class KernelCache(FunctionCache):  # type: ignore[misc]
    """Numba's cache of one kernel, in `CACHE_FOLDER`.

    Args:
      function: what is compiled.
    """

    _impl_class = _CacheImpl

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        self._cache_file = CheckedCacheFile(CACHE_FOLDER, self._impl.filename_base, 0)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled code of a signature; None where it is not there, or of another time, which numba would raise."""
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # a pickle whose classes have changed raises almost anything
            self._cache_file.forget()
            return None
