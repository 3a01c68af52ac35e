"""Compiler options of every kernel, in one place."""

from __future__ import annotations

from typing import Any

from numba import njit

JIT_OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy", "nogil": True}


def kernel(function: Any) -> Any:
    """Compiles `function` with the project's options (cached on disk, IEEE division, no fastmath)."""
    return njit(**JIT_OPTIONS)(function)
