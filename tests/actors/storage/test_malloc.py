"""Freed memory goes back to the OS, holes inside the heap included."""

import subprocess
import sys

import pytest

from actors.storage import malloc

pytestmark = pytest.mark.skipif(malloc._trim is None, reason="a C library other than glibc")

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
for pointer in taken:
    ctypes.memset(ctypes.c_void_p(pointer), 1, 60_000)
for pointer in taken[:-1]:  # the last one keeps the top of the heap in use
    libc.free(pointer)
before = own_mb()
trim_heap()
print(before - own_mb())
"""
LARGE = """
libc.free(libc.malloc(30_000_000))  # after this, glibc serves allocations up to this size from the heap
{}
taken = []
for _ in range(200):
    pointer = libc.malloc(600_000)
    ctypes.memset(ctypes.c_void_p(pointer), 1, 600_000)
    taken.append(pointer)
    libc.malloc(2_000)  # stays allocated
held = own_mb()
for pointer in taken:
    libc.free(pointer)
print(held - own_mb())
"""


def printed(program):
    done = subprocess.run([sys.executable, "-c", LIBC + program], capture_output=True, text=True, check=True)
    return float(done.stdout)


def test_trimming_returns_holes_in_the_heap():
    assert printed(HOLES) > 80  # MB, of 120


def test_large_allocations_go_back_to_the_os_when_they_are_freed():
    assert printed(LARGE.format("")) < 20  # MB, of 120
    assert printed(LARGE.format("limit_fragmentation()")) > 100
