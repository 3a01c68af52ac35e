"""The compiler options of every kernel, and the folder where compiled kernels are cached.

Numba caches a compiled kernel on disk and compiles it again when the kernel's own file changes. It does not notice
changes in other files, so a kernel that inlines kernels of another file would keep their old code. The cache folder is
therefore named after a hash of all sources that can hold kernels: every file of this package and every file of
`KERNEL_PACKAGES` that imports this module, subfolders included. A change in any of them starts an empty cache folder.
The sources in `__pycache__` do not count: they are copies of users' own methods and scenes (`sim_core.plugins`).
"""

from __future__ import annotations

import fcntl
import hashlib
import os
from pathlib import Path
from typing import Any

import numba
from numba import njit
from numba.core.caching import IndexDataCacheFile

JIT_OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy", "nogil": True, "_nrt": False}
"""On-disk cache, IEEE division, no fastmath. Without numba's run-time (NRT) a kernel cannot allocate memory."""
KERNEL_PACKAGES = ("actors", "learner")
"""The other packages with kernels. They lie beside this one."""


def _cache_folder() -> str:
    """Folder of the kernels that were compiled from the present sources.

    It lies beside the sources if that folder is writable, else in the user's cache folder. Numba's own setting
    NUMBA_CACHE_DIR takes precedence over both.
    """
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for folder in (package, *(package.parent / name for name in KERNEL_PACKAGES)):
        for source in sorted(folder.rglob("*.py")):
            name, content = source.relative_to(package.parent), source.read_bytes()
            if "__pycache__" not in name.parts and (folder == package or b"sim_core.jit" in content):
                digest.update(str(name).encode() + b"\0" + content)
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "shoal"
    beside = package / "__pycache__" if os.access(package, os.W_OK) else user
    base = Path(numba.config.CACHE_DIR) if numba.config.CACHE_DIR else beside
    return str(base / f"kernels-{digest.hexdigest()[:16]}")


CACHE_FOLDER = _cache_folder()
"""The folder of this version's compiled kernels."""


class LockedCacheFile(IndexDataCacheFile):
    """The cached signatures of one kernel, which several processes may save at once.

    Numba's own class locks nothing: two processes that save different signatures can choose the same file name, and a
    third one then loads the code of the wrong signature.
    """

    def save(self, key: Any, data: Any) -> None:
        """Saves the code of one signature."""
        with open(f"{self._index_path}.lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            super().save(key, data)


def _compiled(function: Any, **options: Any) -> Any:
    previous = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = CACHE_FOLDER  # read when the dispatcher is created; other users of numba keep theirs
    try:
        made = njit(**(JIT_OPTIONS | options))(function)
    finally:
        numba.config.CACHE_DIR = previous
    made._cache._cache_file.__class__ = LockedCacheFile
    return made


def kernel(function: Any) -> Any:
    """Compiles a function that Python calls, with the project's options."""
    return _compiled(function)


def inlined(function: Any, **options: Any) -> Any:
    """Compiles a function that only kernels call; it is inlined into each of them."""
    return _compiled(function, forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, **options)


def inlined_blas(function: Any) -> Any:
    """Compiles as `inlined` does, but with numba's run-time (NRT), which `np.dot` needs to call BLAS."""
    return inlined(function, _nrt=True)
