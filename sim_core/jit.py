"""Compiler options of every kernel, in one place.

Numba caches compiled kernels on disk, but it notices changes of a kernel's own file only: one that takes in kernels
of other files would go on with their old code. The cache therefore lies in a folder that is named after the content of
all sources of this package, and of those of its neighbours that have kernels; changed sources start an empty one.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

import numba
from numba import njit

JIT_OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy", "nogil": True, "_nrt": False}
"""Cached on disk, IEEE division, no fastmath, and without numba's run-time, so that a kernel cannot allocate."""
NEIGHBOURS = ("actors", "learner")
"""Packages beside this one that have kernels, too."""


def _cache_folder() -> str:
    """Folder of this version's compiled kernels: beside the sources, or else in the user's cache.

    Numba's own setting NUMBA_CACHE_DIR, where given, takes the place of either.
    """
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for folder in (package, *(package.parent / name for name in NEIGHBOURS)):
        for source in sorted(folder.rglob("*.py")):
            content = source.read_bytes()
            if folder == package or b"sim_core.jit" in content:
                digest.update(str(source.relative_to(package.parent)).encode() + b"\0" + content)
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "shoal"
    beside = package / "__pycache__" if os.access(package, os.W_OK) else user
    base = Path(numba.config.CACHE_DIR) if numba.config.CACHE_DIR else beside
    return str(base / f"kernels-{digest.hexdigest()[:16]}")


CACHE_FOLDER = _cache_folder()
"""Where this version's compiled kernels lie."""


def _compiled(function: Any, **options: Any) -> Any:
    theirs = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = CACHE_FOLDER  # read while the kernel is made; other users of numba keep their setting
    try:
        return njit(**(JIT_OPTIONS | options))(function)
    finally:
        numba.config.CACHE_DIR = theirs


def kernel(function: Any) -> Any:
    """Compiles `function`, called from Python, with the project's options."""
    return _compiled(function)


def inlined(function: Any, **options: Any) -> Any:
    """Compiles `function` as a part of the kernels that call it, each of which takes it in whole."""
    return _compiled(function, forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, **options)


def product(function: Any) -> Any:
    """Compiles `function` as `inlined` does, but with numba's run-time: `np.dot`, numba's way to BLAS, needs it."""
    return inlined(function, _nrt=True)
