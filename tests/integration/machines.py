"""Network namespaces as machines, and the cables between them: quick ones, and a slow one that can be cut."""

import heapq
import os
import secrets
import select
import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from fcntl import ioctl
from pathlib import Path
from random import Random

import pytest

from tests.integration.conftest import PATIENCE_S, clean_environment
from tests.integration.ray_head import ROOT

TUN = Path("/dev/net/tun")
SET_INTERFACE, RAW_IP_PACKETS = 0x400454CA, 0x1001
LARGEST_PACKET = 60_000
"""Bytes: large packets keep a forwarder in Python ahead of Ray."""


def root(*words: str) -> None:
    subprocess.run(words, check=True, capture_output=True)


@contextmanager
def machines(*names: str) -> Iterator[list[str]]:
    """A namespace for each of `names`; a test that cannot make them is skipped."""
    if os.geteuid() != 0 or not shutil.which("ip") or not TUN.exists():
        pytest.skip("needs root, iproute2 and /dev/net/tun, to make networks of machines")
    made = [f"shoal-{os.getpid()}-{name}" for name in names]
    try:
        for name in made:
            root("ip", "netns", "add", name)
            root("ip", "-n", name, "link", "set", "lo", "up")
        yield made
    finally:
        for name in made:
            root("ip", "netns", "del", name)


def plug_in(machine: str, interface: str, address: str) -> None:
    root("ip", "-n", machine, "addr", "add", f"{address}/24", "dev", interface)
    root("ip", "-n", machine, "link", "set", interface, "up")


def connect(one: str, address: str, other: str, other_address: str) -> None:
    """A quick cable."""
    ours, theirs = (f"c{secrets.token_hex(5)}" for _ in range(2))
    root("ip", "link", "add", ours, "netns", one, "type", "veth", "peer", "name", theirs, "netns", other)
    plug_in(one, ours, address)
    plug_in(other, theirs, other_address)


def on(machine: str, *words: str, auth: dict[str, str] | None = None, cwd: Path = ROOT) -> subprocess.CompletedProcess:
    """A command on a machine, once it has ended."""
    return subprocess.run(
        [*at(machine), *words],
        env={**clean_environment(), **(auth or {})},
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )


def at(machine: str) -> tuple[str, ...]:
    """What goes before a command that is to run on a machine."""
    return ("ip", "netns", "exec", machine)


class SlowCable:
    """A cable in which every packet takes 0 to `delay_ms` longer, in order, until it is cut.

    Args:
      one, address, other, other_address: machines and their addresses at its ends.
      delay_ms: the longest delay.
    """

    def __init__(self, one: str, address: str, other: str, other_address: str, delay_ms: float) -> None:
        ends = [f"t{secrets.token_hex(5)}" for _ in range(2)]
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, *ends, str(delay_ms)],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout.readline() == "ready\n"
        for machine, end, own in zip((one, other), ends, (address, other_address), strict=True):
            root("ip", "link", "set", end, "netns", machine)
            root("ip", "-n", machine, "link", "set", end, "mtu", str(LARGEST_PACKET))
            plug_in(machine, end, own)

    def cut(self, seconds: float) -> None:
        """Loses every packet for so long; returns after that."""
        for word in ("cut", "whole"):
            self._process.stdin.write(f"{word}\n")
            self._process.stdin.flush()
            time.sleep(seconds if word == "cut" else 0.0)

    def close(self) -> None:
        self._process.stdin.close()
        self._process.wait(PATIENCE_S)
        self._process.stdout.close()


def interface(name: str) -> int:
    """A new network interface of this machine, as a file of its packets."""
    file = os.open(TUN, os.O_RDWR | os.O_NONBLOCK)
    ioctl(file, SET_INTERFACE, struct.pack("16sH22x", name.encode(), RAW_IP_PACKETS))
    return file


def forward(one: int, other: int, longest_s: float) -> None:
    """Carries packets between two interfaces until the input ends; a line `cut` or `whole` on it cuts or mends."""
    peer, last = {one: other, other: one}, {one: 0.0, other: 0.0}
    due: list[tuple[float, int, int, bytes]] = []
    rng, count, is_cut = Random(0), 0, False
    while True:
        wait_s = max(0.0, due[0][0] - time.monotonic()) if due else None
        for ready in select.select([one, other, sys.stdin], [], [], wait_s)[0]:
            if ready is sys.stdin:
                word = sys.stdin.readline()
                if not word:
                    return
                is_cut = word == "cut\n"
                continue
            packet = os.read(ready, 1 << 16)
            last[ready] = max(last[ready], time.monotonic() + rng.uniform(0.0, longest_s))
            if not is_cut:
                count += 1
                heapq.heappush(due, (last[ready], count, peer[ready], packet))
        while due and due[0][0] <= time.monotonic():
            _, _, to, packet = heapq.heappop(due)
            try:
                os.write(to, packet)
            except OSError:
                continue  # the other end is not plugged in, or full: the packet is lost, as packets are


if __name__ == "__main__":
    files = [interface(name) for name in sys.argv[1:3]]
    print("ready", flush=True)
    forward(*files, float(sys.argv[3]) / 1000)
