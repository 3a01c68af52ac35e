"""Memory that a process has freed and keeps: where blocks of transitions come and go, the heap gets holes.

Only the end of glibc's heap goes back to the system unasked. What a learner uses of it stays the same, but the holes
grew by up to 7 MB in every million env steps, with no end in sight after an hour. Small pieces that stay lie scattered
in the room of large ones that went, so that giving back the holes is not enough: large pieces lie apart from the start.
"""

from __future__ import annotations

import ctypes

_libc = ctypes.CDLL(None)
_trim = getattr(_libc, "malloc_trim", None)
"""glibc's; None with another C library, whose business it is then."""
_MMAP_THRESHOLD, _ARENA_MAX = -3, -8
"""mallopt's numbers for what is set (malloc.h)."""
LARGE_BYTES = 256 * 1024
"""What is as large as this goes back to the system when it is freed."""
ARENAS = 4
"""Heaps of a process; glibc's own limit is eight for every core, each with holes of its own."""


def keep_large_apart() -> None:
    """Has this process take large pieces of memory from the system one by one; without, glibc soon ceases to."""
    if _trim is not None:
        _libc.mallopt(_MMAP_THRESHOLD, LARGE_BYTES)
        _libc.mallopt(_ARENA_MAX, ARENAS)


def give_back() -> None:
    """Returns the holes in this process's heap to the system; takes a few milliseconds."""
    if _trim is not None:
        _trim(0)
