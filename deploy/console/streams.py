"""Standard output and error that cannot decide a run's fate: what they do not take is left out."""

from __future__ import annotations

import io
import os
import sys
from contextlib import suppress
from typing import Any, TextIO


class _LosableFile(io.FileIO):
    """A file that drops what its device refuses: a closed pipe, a terminal that is gone, a full disk.

    Args:
      descriptor: of the file; it stays open.
      name: what the user calls it.
    """

    def __init__(self, descriptor: int, name: str) -> None:
        super().__init__(descriptor, "w", closefd=False)
        self._what = name
        self._is_lost = False

    def write(self, data: Any) -> int:
        """Writes or drops the data; says once, where that is still possible, that some is dropped."""
        try:
            return super().write(data)
        except OSError as error:
            if not self._is_lost:
                self._is_lost = True
                with suppress(OSError, ValueError):
                    os.write(2, f"shoal: {self._what} takes nothing ({error.strerror}); going on without it\n".encode())
            return len(memoryview(data).cast("B"))


def prepare_streams() -> None:
    """Lets standard output and error take any text, in any encoding, and also where they are closed.

    The null device takes the place of a closed one, or else the next file that is opened would get its number.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)
            os.dup2(opened, descriptor)
            os.set_inheritable(descriptor, True)
            if opened != descriptor:
                os.close(opened)
    sys.stdout = sys.stdout or open(1, "w", encoding="utf-8", closefd=False)
    sys.stderr = sys.stderr or open(2, "w", encoding="utf-8", closefd=False)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="replace")


def outlive_streams() -> None:
    """Lets the process go on where nobody takes what it prints; streams that a caller has put there stay."""
    sys.stdout = _losable(sys.stdout, sys.__stdout__, "standard output")
    sys.stderr = _losable(sys.stderr, sys.__stderr__, "standard error")


def _losable(stream: TextIO, own: TextIO | None, name: str) -> TextIO:
    if not isinstance(stream, io.TextIOWrapper) or stream is not own:
        return stream
    with suppress(OSError):
        stream.flush()
    file = io.BufferedWriter(_LosableFile(stream.fileno(), name))
    return io.TextIOWrapper(file, stream.encoding, stream.errors, line_buffering=stream.line_buffering)
