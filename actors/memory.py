"""Memory that a process has freed and keeps: where blocks of transitions come and go, the heap gets holes.

Only the end of glibc's heap goes back to the system unasked. What a learner uses of it stays the same, but the holes
grew by 7 MB in every million env steps on a busy machine, with no end in sight after an hour.
"""

from __future__ import annotations

import ctypes

_trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
"""glibc's; None with another C library, whose business it is then."""


def give_back() -> None:
    """Returns the holes in this process's heap to the system; takes a few milliseconds."""
    if _trim is not None:
        _trim(0)
