"""Serving a page from the terminal, until Ctrl-C."""

from __future__ import annotations

from dashboards.pages.server import PageServer
from deploy.console.terminal import plain_console


def serve_until_interrupted(server: PageServer) -> int:
    """Prints the page's URL and serves it until Ctrl-C; returns the exit code 0."""
    plain_console().print(f"{server.url}  (Ctrl-C ends it)", soft_wrap=True)
    try:
        server.serve()
    except KeyboardInterrupt:
        plain_console().print("ended")
    return 0
