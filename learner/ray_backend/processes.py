"""Processes of a Ray that this process starts: those that a run on one machine does not need are left out."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from ray._private.node import Node

UNUSED = ("start_api_server", "start_monitor")
"""Methods of Ray's Node that start what no run on one machine uses: the server of the dashboard, which runs even where
there is no dashboard, and the autoscaler. Each costs half a second of CPU time or more, and `ray.init` waits for the
former."""


@contextmanager
def needed_processes() -> Iterator[None]:
    """Has a Ray that starts in the `with` block leave out what `UNUSED` starts, for which Ray has no option.

    A Ray that has no such methods starts as it does by itself.
    """
    before = {name: getattr(Node, name) for name in UNUSED if hasattr(Node, name)}
    for name in before:
        setattr(Node, name, _start_nothing)
    try:
        yield
    finally:
        for name, method in before.items():
            setattr(Node, name, method)


def _start_nothing(node: Node, **options: object) -> None:
    """Takes the place of a method in UNUSED."""
