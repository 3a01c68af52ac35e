"""Serves a page and its data to browsers on this machine."""

from __future__ import annotations

import contextlib
import hashlib
import json
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
"""Answers a request from its query: a string is sent as HTML, anything else as JSON.

A LookupError is answered by 404, a ConfigError, ValueError or OSError by 409, each with its message as JSON.
"""
Change = Callable[[Mapping[str, Any]], Any]
"""Answers a request that changes something, from the JSON object that it sends; else as `Answer`."""
LONGEST_CHANGE_BYTES = 4096


def episode_number(query: Query) -> int:
    """The number of the episode that a page requests; raises LookupError if it is none."""
    text = query.get("number", "")
    if not text.isdecimal():
        raise LookupError(f"episode {text!r}")
    return int(text)


class PageServer:
    """An HTTP server on 127.0.0.1.

    Requests are answered one at a time, so that answers need not be thread-safe. Requests with another Host header are
    refused: otherwise a foreign page could read the data by pointing its own host name to 127.0.0.1 (DNS rebinding).
    Requests that change something must be POSTs of JSON, which browsers let no foreign page send.

    Args:
      answers: the answer of each path, such as `/` and `/data.json`.
      port: the port to listen on; 0 takes a free one.
      changes: the answer of each path that changes something.

    Raises:
      ConfigError: the port is taken.
    """

    def __init__(self, answers: Mapping[str, Answer], port: int, changes: Mapping[str, Change] | None = None) -> None:
        lock = threading.Lock()

        class Handler(_Handler):
            def answer(self, path: str, query: Query) -> Any:
                with lock:
                    return answers[path](query)

            def change(self, path: str, values: Mapping[str, Any]) -> Any:
                with lock:
                    return (changes or {})[path](values)

        try:
            self._server = ThreadingHTTPServer((HOST, port), Handler)
        except OSError as error:
            raise ConfigError(
                f"port {port} cannot be used ({error.strerror}); choose another --port, 0 for any"
            ) from error

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{HOST}:{self._server.server_port}/"

    def serve(self) -> None:
        """Answers requests until `close` is called or Ctrl-C."""
        self._server.serve_forever(poll_interval=0.2)

    def close(self) -> None:
        """Ends `serve`, which runs in another thread, and frees the port."""
        self._server.shutdown()
        self._server.server_close()


class _Handler(BaseHTTPRequestHandler):
    """Handles requests, one per connection; the server's subclass answers them."""

    def answer(self, path: str, query: Query) -> Any:
        """The answer to a request; see `Answer`."""
        raise NotImplementedError

    def change(self, path: str, values: Mapping[str, Any]) -> Any:
        """The answer to a request that changes something; see `Change`."""
        raise NotImplementedError

    def do_GET(self) -> None:
        """Sends the answer, or an error as JSON."""
        parts = urlsplit(self.path)
        self._respond(lambda: self.answer(parts.path, dict(parse_qsl(parts.query))))

    def do_POST(self) -> None:
        """Changes what the request asks for and sends the answer, or an error as JSON."""
        self._respond(lambda: self.change(urlsplit(self.path).path, self._sent()))

    def _sent(self) -> Mapping[str, Any]:
        """The JSON object that the request sends; raises ValueError if it sends something else."""
        length = self.headers.get("Content-Length", "")
        is_short = length.isdecimal() and int(length) <= LONGEST_CHANGE_BYTES
        if self.headers.get_content_type() != "application/json" or not is_short:
            raise ValueError(f"send a JSON object of at most {LONGEST_CHANGE_BYTES} bytes as application/json")
        values = json.loads(self.rfile.read(int(length)))
        if not isinstance(values, dict):
            raise ValueError("send a JSON object")
        return values

    def _respond(self, answer: Callable[[], Any]) -> None:
        host = (self.headers.get("Host") or "").rsplit(":", 1)[0]
        if host not in (HOST, "localhost"):
            return self._send(HTTPStatus.FORBIDDEN, {"error": f"this server is {HOST}, not {host}"})
        try:
            self._send(HTTPStatus.OK, answer())
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
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # the browser has closed the connection
            self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Logs nothing: a page that refreshes would fill the terminal."""
