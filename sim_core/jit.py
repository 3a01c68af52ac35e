"""The compiler options of every kernel. `sim_core.kernel_cache` says where the compiled code is kept."""

from __future__ import annotations

from typing import Any

from numba import njit, typeof

from sim_core.kernel_cache import KernelCache

JIT_OPTIONS: dict[str, Any] = {"error_model": "numpy", "nogil": True, "_nrt": False}
"""IEEE division, no fastmath. Without numba's run-time (NRT) a kernel cannot allocate memory."""


def _compiled(function: Any, **options: Any) -> Any:
    made = njit(**(JIT_OPTIONS | options))(function)
    made._cache = KernelCache(made.py_func)
    return made


def kernel(function: Any) -> Any:
    """Compiles a function that Python calls, with the project's options."""
    return _compiled(function)


def for_types_of(function: Any, *arguments: Any) -> Any:
    """The compiled code of a kernel for arguments of these types, to be called with such arguments alone.

    A kernel looks up the types of its arguments in every call, which takes a microsecond for a named tuple of arrays.
    """
    return function.compile(tuple(typeof(argument) for argument in arguments))


class StateKernel:
    """A kernel whose first argument is a named tuple of arrays: it is looked up once for each, not in every call.

    Numba looks up 0.1 microseconds an array, which for a WorldState is ten times what passing it takes. Until another
    tuple comes, all other arguments must have the types of the first call with it: C-contiguous arrays of the same
    dtypes.

    Args:
      function: a kernel.
    """

    def __init__(self, function: Any) -> None:
        self._function = function
        self._state: Any = None
        self._code: Any = None

    def __call__(self, state: Any, *arguments: Any) -> Any:
        """Calls the kernel."""
        if state is not self._state:
            self._code = for_types_of(self._function, state, *arguments)
            self._state = state
        return self._code(state, *arguments)


def inlined(function: Any, **options: Any) -> Any:
    """Compiles a function that only kernels call; it is inlined into each of them."""
    return _compiled(function, forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, **options)


def inlined_blas(function: Any) -> Any:
    """Compiles as `inlined` does, but with numba's run-time (NRT), which `np.dot` needs to call BLAS."""
    return inlined(function, _nrt=True)
