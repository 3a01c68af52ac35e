"""What a process has freed goes back to the system, holes in its heap too."""

import subprocess
import sys

import pytest

from actors import memory

PROGRAM = """
import ctypes, psutil
from actors.memory import give_back
libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
libc.free.argtypes = [ctypes.c_void_p]
taken = [libc.malloc(60_000) for _ in range(2_000)]
for place in taken:
    ctypes.memset(ctypes.c_void_p(place), 1, 60_000)
for place in taken[:-1]:  # the last one holds the end of the heap
    libc.free(place)
before = psutil.Process().memory_full_info().uss
give_back()
print((before - psutil.Process().memory_full_info().uss) / 1e6)
"""


@pytest.mark.skipif(memory._trim is None, reason="a C library without malloc_trim")
def test_holes_in_the_heap_go_back_to_the_system():
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    assert float(done.stdout) > 80  # MB, of 120
