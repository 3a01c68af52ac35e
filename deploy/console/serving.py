"""Serving a page from the terminal, until Ctrl-C."""

from __future__ import annotations

from rich.console import Console

from dashboards.pages.server import PageServer


def serve_until_interrupted(server: PageServer) -> int:
    """Prints the page's URL and serves it until Ctrl-C; returns the exit code 0."""
    Console().print(f"{server.url}  (Ctrl-C ends it)", highlight=False, soft_wrap=True)
    try:
        server.serve()
    except KeyboardInterrupt:
        Console().print("ended", highlight=False)
    return 0
