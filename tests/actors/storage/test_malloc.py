"""What a process has freed goes back to the system, holes in its heap too."""

import subprocess
import sys

import pytest

from actors.storage import malloc as memory

pytestmark = pytest.mark.skipif(memory._trim is None, reason="a C library other than glibc")

LIBC = """
import ctypes, psutil
from actors.storage.malloc import trim_heap, limit_fragmentation
libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
libc.free.argtypes = [ctypes.c_void_p]

def own_mb():
    return psutil.Process().memory_full_info().uss / 1e6
"""
HOLES = """
taken = [libc.malloc(60_000) for _ in range(2_000)]
for place in taken:
    ctypes.memset(ctypes.c_void_p(place), 1, 60_000)
for place in taken[:-1]:  # the last one holds the end of the heap
    libc.free(place)
before = own_mb()
trim_heap()
print(before - own_mb())
"""
LARGE = """
libc.free(libc.malloc(30_000_000))  # whereupon glibc keeps pieces of up to this size in its heap
{}
taken = []
for _ in range(200):
    place = libc.malloc(600_000)
    ctypes.memset(ctypes.c_void_p(place), 1, 600_000)
    taken.append(place)
    libc.malloc(2_000)  # which stays
held = own_mb()
for place in taken:
    libc.free(place)
print(held - own_mb())
"""


def printed(program):
    done = subprocess.run([sys.executable, "-c", LIBC + program], capture_output=True, text=True, check=True)
    return float(done.stdout)


def test_holes_in_the_heap_go_back_to_the_system():
    assert printed(HOLES) > 80  # MB, of 120


def test_large_pieces_go_back_to_the_system_when_they_are_freed():
    assert printed(LARGE.format("")) < 20  # MB, of 120
    assert printed(LARGE.format("limit_fragmentation()")) > 100
