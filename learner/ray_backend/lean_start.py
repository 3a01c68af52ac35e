"""What a Ray that this process starts does without: processes and checks that no run on one machine needs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from ray._private import utils
from ray._private.node import Node

UNUSED: tuple[tuple[object, str], ...] = (
    (Node, "start_api_server"),
    (Node, "start_monitor"),
    (utils, "get_dashboard_dependency_error"),
)
"""Functions of Ray's, and where they are. The first two start the server of the dashboard, which runs even where there
is no dashboard, and the autoscaler. The last imports the dashboard's libraries to see whether they are installed, as
shoal's requirements say. Each costs half a second of CPU time or so, and `ray.init` waits for the first and last."""


@contextmanager
def lean_start() -> Iterator[None]:
    """Has a Ray that starts in the `with` block leave out what is in `UNUSED`, for which Ray has no options.

    A Ray that has no such functions starts as it does by itself.
    """
    before = [(place, name, getattr(place, name)) for place, name in UNUSED if hasattr(place, name)]
    for place, name, _ in before:
        setattr(place, name, _nothing)
    try:
        yield
    finally:
        for place, name, function in before:
            setattr(place, name, function)


def _nothing(*arguments: object, **options: object) -> None:
    """Takes the place of a function in UNUSED."""
