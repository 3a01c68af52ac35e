"""The page server over HTTP: its answers, and the requests that it refuses."""

from __future__ import annotations

import http.client
import json
import socket
import threading
from collections.abc import Iterator

import psutil
import pytest

from dashboards.pages.server import HOST, PageServer
from sim_core.checks import ConfigError


def broken(query):
    raise ConfigError("the run has no checkpoint yet")


def missing(query):
    raise LookupError("episode 7")


@pytest.fixture
def values() -> dict[str, int]:
    return {"n": 1}


@pytest.fixture
def server(values: dict[str, int]) -> Iterator[PageServer]:
    answers = {
        "/": lambda query: "<p>page</p>",
        "/data.json": lambda query: values,
        "/echo.json": dict,
        "/broken.json": broken,
        "/missing.json": missing,
    }
    changes = {"/set.json": lambda sent: values.update(sent) or values}
    made = PageServer(answers, 0, changes)
    thread = threading.Thread(target=made.serve)
    thread.start()
    yield made
    made.close()
    thread.join(10)
    assert not thread.is_alive()


def get(server: PageServer, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    port = int(server.url.rsplit(":", 1)[1].strip("/"))
    connection = http.client.HTTPConnection(HOST, port, timeout=20)
    connection.request("GET", path, headers={name.replace("_", "-"): value for name, value in headers.items()})
    answer = connection.getresponse()
    found = answer.status, dict(answer.getheaders()), answer.read()
    connection.close()
    return found


def test_text_is_sent_as_a_page_and_all_else_as_json(server: PageServer):
    status, headers, body = get(server, "/")
    assert (status, body, headers["Content-Type"]) == (200, b"<p>page</p>", "text/html; charset=utf-8")
    assert "connect-src 'self'" in headers["Content-Security-Policy"]
    status, headers, body = get(server, "/echo.json?key=a%2Fb&n=3")
    assert (status, json.loads(body), headers["Content-Type"]) == (200, {"key": "a/b", "n": "3"}, "application/json")


def test_unchanged_answers_are_not_sent_again(server: PageServer, values: dict[str, int]):
    _, headers, body = get(server, "/data.json")
    tag = headers["ETag"]
    assert json.loads(body) == {"n": 1}
    assert get(server, "/data.json", If_None_Match=tag)[::2] == (304, b"")
    values["n"] = 2
    status, headers, body = get(server, "/data.json", If_None_Match=tag)
    assert (status, json.loads(body)) == (200, {"n": 2}) and headers["ETag"] != tag


@pytest.mark.parametrize(
    ("path", "status", "reason"),
    [
        ("/nothing", 404, "there is no '/nothing'"),
        ("/missing.json", 404, "there is no episode 7"),
        ("/broken.json", 409, "the run has no checkpoint yet"),
    ],
)
def test_refusals_state_the_reason(server: PageServer, path: str, status: int, reason: str):
    found = get(server, path)
    assert (found[0], json.loads(found[2])) == (status, {"error": reason})


def post(server: PageServer, path: str, body: str, **headers: str) -> tuple[int, object]:
    port = int(server.url.rsplit(":", 1)[1].strip("/"))
    connection = http.client.HTTPConnection(HOST, port, timeout=20)
    named = {"Content-Type": "application/json"} | {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request("POST", path, body, named)
    answer = connection.getresponse()
    found = answer.status, json.loads(answer.read())
    connection.close()
    return found


def test_a_change_is_made_by_a_post_of_json_alone(server: PageServer, values: dict[str, int]):
    assert post(server, "/set.json", '{"n": 5}') == (200, {"n": 5}) and values == {"n": 5}
    assert get(server, "/set.json?n=6")[0] == 404
    assert post(server, "/data.json", "{}")[0] == 404
    for body, headers in (
        ('{"n": 7}', {"Content_Type": "text/plain"}),  # what a foreign page may send
        ('{"n": 7}', {"Host": "example.org:80"}),
        ("[7]", {}),
        ("{", {}),
        (json.dumps({"n": "7" * 5000}), {}),
    ):
        assert post(server, "/set.json", body, **headers)[0] in (403, 409), (body[:20], headers)
    assert values == {"n": 5}


def test_another_hosts_name_is_refused(server: PageServer):
    """Otherwise a foreign page could point its own host name at this machine and read the answers."""
    assert get(server, "/data.json", Host="example.org:80")[0] == 403
    assert get(server, "/data.json", Host="localhost:1")[0] == 200


def test_only_this_machine_can_connect(server: PageServer):
    port = int(server.url.rsplit(":", 1)[1].strip("/"))
    cards = psutil.net_if_addrs().values()
    own = {place.address for places in cards for place in places if place.family == socket.AF_INET}
    assert HOST in own
    for address in own - {HOST}:
        with pytest.raises(OSError, match="refused|timed out"):
            socket.create_connection((address, port), timeout=2)
    assert server.url == f"http://127.0.0.1:{port}/"


def test_a_taken_port_is_refused_in_a_sentence(server: PageServer):
    port = int(server.url.rsplit(":", 1)[1].strip("/"))
    with pytest.raises(ConfigError, match=rf"port {port} cannot be used .* choose another --port"):
        PageServer({}, port)
