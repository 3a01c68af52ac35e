"""Serves a page and the data that it asks for, on this machine alone."""

from __future__ import annotations

import contextlib
import hashlib
import threading
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from dashboards.pages.assets import SERVED, to_json
from sim_core.checks import ConfigError

HOST = "127.0.0.1"
Query = Mapping[str, str]
Answer = Callable[[Query], Any]
"""Makes what a path answers from the query: text is HTML, anything else becomes JSON.

A LookupError (nothing there), a ConfigError, a ValueError and an OSError become an answer that says so.
"""


class PageServer:
    """An HTTP server on 127.0.0.1.

    Requests are answered one at a time, so that what answers need not be thread-safe. Requests that come under another
    host's name are refused: a page from elsewhere cannot read the data by pointing its own name here.

    Args:
      answers: what each path answers, such as `/` and `/data.json`.
      port: where to listen; 0 takes a free one.

    Raises:
      ConfigError: the port is taken.
    """

    def __init__(self, answers: Mapping[str, Answer], port: int) -> None:
        lock = threading.Lock()

        class Handler(_Handler):
            def answer(self, path: str, query: Query) -> Any:
                with lock:
                    return answers[path](query)

        try:
            self._server = ThreadingHTTPServer((HOST, port), Handler)
        except OSError as error:
            raise ConfigError(
                f"port {port} cannot be used ({error.strerror}); choose another --port, 0 for any"
            ) from error

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{HOST}:{self._server.server_port}/"

    def serve(self) -> None:
        """Answers until `close` or an interrupt."""
        self._server.serve_forever(poll_interval=0.2)

    def close(self) -> None:
        """Ends `serve` in another thread and frees the port."""
        self._server.shutdown()
        self._server.server_close()


class _Handler(BaseHTTPRequestHandler):
    """GET alone, a connection a request; what it answers is in the subclass that the server makes."""

    def answer(self, path: str, query: Query) -> Any:
        """What a path answers."""
        raise NotImplementedError

    def do_GET(self) -> None:
        """Answers a request."""
        host = (self.headers.get("Host") or "").rsplit(":", 1)[0]
        if host not in (HOST, "localhost"):
            return self._send(HTTPStatus.FORBIDDEN, {"error": f"this server is {HOST}, not {host}"})
        parts = urlsplit(self.path)
        try:
            self._send(HTTPStatus.OK, self.answer(parts.path, dict(parse_qsl(parts.query))))
        except LookupError as error:
            self._send(HTTPStatus.NOT_FOUND, {"error": f"there is no {error}"})
        except (ConfigError, ValueError, OSError) as error:
            self._send(HTTPStatus.CONFLICT, {"error": str(error)})

    def _send(self, status: HTTPStatus, content: Any) -> None:
        is_page = isinstance(content, str)
        body = (content if is_page else to_json(content)).encode()
        tag = f'"{hashlib.sha256(body).hexdigest()[:16]}"'
        if status is HTTPStatus.OK and self.headers.get("If-None-Match") == tag:
            status, body = HTTPStatus.NOT_MODIFIED, b""
        self.send_response(status)
        headers = {
            "Content-Type": "text/html; charset=utf-8" if is_page else "application/json",
            "Content-Length": str(len(body)),
            "Content-Security-Policy": SERVED,
            "X-Content-Type-Options": "nosniff",
            "Cache-Control": "no-cache",
            "ETag": tag,
        }
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # the reader has gone
            self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Says nothing: a page that refreshes would fill the terminal."""
