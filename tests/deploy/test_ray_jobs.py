"""The client of Ray's job server, against test servers that refuse, disconnect, or do not exist."""

import asyncio
import socket
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import pytest
from aiohttp import web

from deploy.ray_jobs import JobServer
from sim_core.checks import ConfigError
from tests.integration.conftest import clean_environment

ROOT = Path(__file__).parents[2]
TOKEN = "a" * 64
LOG = "".join(f"line {i}\n" for i in range(100))


@pytest.fixture(autouse=True)
def no_cluster(monkeypatch, tmp_path):
    """An environment that names no cluster and no token file, restored after the test."""
    for name in ("RAY_API_SERVER_ADDRESS", "RAY_ADDRESS", "RAY_AUTH_TOKEN_PATH"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path))


@contextmanager
def serving(*routes: web.RouteDef):
    """Serves these routes on a free port of this machine; yields the address."""
    loop, ready, address = asyncio.new_event_loop(), threading.Event(), []

    async def start() -> web.AppRunner:
        app = web.Application()
        app.add_routes(routes)
        runner = web.AppRunner(app)
        await runner.setup()
        site = web.TCPSite(runner, "127.0.0.1", 0)
        await site.start()
        host, port = runner.addresses[0][:2]
        address.append(f"http://{host}:{port}")
        return runner

    def run() -> None:
        asyncio.set_event_loop(loop)
        runner = loop.run_until_complete(start())
        ready.set()
        loop.run_forever()
        loop.run_until_complete(runner.cleanup())
        loop.close()

    thread = threading.Thread(target=run)
    thread.start()
    assert ready.wait(30)
    try:
        yield address[0]
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join(30)


def answering(status: int, text: str = "") -> web.RouteDef:
    async def answer(request: web.Request) -> web.Response:
        return web.Response(status=status, text=text)

    return web.route("*", "/{path:.*}", answer)


def version() -> web.RouteDef:
    async def answer(request: web.Request) -> web.Response:
        return web.json_response({"version": "4", "ray_version": "2.60.0", "ray_commit": "x"})

    return web.get("/api/version", answer)


@pytest.mark.parametrize("status", [401, 403])
def test_a_cluster_that_asks_for_a_token_is_explained(status):
    with serving(answering(status)) as address, pytest.raises(ConfigError) as refused:
        JobServer(address)
    text = str(refused.value)
    assert address in text and "RAY_AUTH_MODE=token" in text and "RAY_AUTH_TOKEN" in text
    assert "\n" not in text


def test_an_unreachable_server_is_reported_in_one_sentence():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
        with pytest.raises(ConfigError, match=f"answers at http://{address} .*ray start --head.*--address"):
            JobServer(address)


def test_an_address_with_another_scheme_is_refused():
    with pytest.raises(ConfigError, match="--address must be a dashboard"):
        JobServer("ray://127.0.0.1:10001")


def test_the_given_address_overrides_the_environment(monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    monkeypatch.setenv("RAY_API_SERVER_ADDRESS", "http://127.0.0.1:2")
    with serving(version()) as address:
        assert JobServer(address).address == address


@pytest.mark.parametrize(
    ("environment", "travels"),
    [
        ({"RAY_AUTH_MODE": "disabled", "RAY_AUTH_TOKEN": TOKEN}, False),
        ({"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": TOKEN}, True),
        ({"RAY_AUTH_TOKEN": TOKEN}, True),
        ({}, False),
    ],
)
def test_a_token_is_sent_if_there_is_one(environment, travels):
    seen = []

    async def answer(request: web.Request) -> web.Response:
        seen.append(request.headers.get("authorization"))
        return web.json_response({"version": "4", "ray_version": "2.60.0", "ray_commit": "x"})

    with serving(web.get("/api/version", answer)) as address:
        command = [sys.executable, "-m", "deploy", "submit", "--address", address, "train"]
        done = subprocess.run(command, cwd=ROOT, env={**clean_environment(), **environment}, check=False)
    assert done.returncode == 2, "the server has no jobs"
    assert set(seen) == {f"Bearer {TOKEN}" if travels else None}


def job_info(status: str) -> dict:
    return {"type": "SUBMISSION", "submission_id": "j", "status": status, "entrypoint": "e", "driver_exit_code": 3}


def test_a_log_continues_where_a_broken_connection_left_it():
    connections = []

    async def tail(request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse()
        await socket.prepare(request)
        connections.append(socket)
        whole = len(connections) == 3
        for at in range(0, len(LOG) if whole else 300 * len(connections), 50):
            await socket.send_str(LOG[at : at + 50])
        if not whole:
            request.transport.abort()
        return socket

    async def info(request: web.Request) -> web.Response:
        return web.json_response(job_info("FAILED" if len(connections) == 3 else "RUNNING"))

    written = []
    with serving(version(), web.get("/api/jobs/j", info), web.get("/api/jobs/j/logs/tail", tail)) as address:
        ending = JobServer(address).follow("j", lambda: False, written.append, "stopping")
    assert "".join(written) == LOG
    assert len(connections) == 3
    assert ending == ("FAILED", 3)


def test_a_job_is_stopped_once_and_followed_to_its_end():
    stopped = asyncio.Event()
    calls = []

    async def tail(request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse()
        await socket.prepare(request)
        await socket.send_str("begun\n")
        await stopped.wait()
        await socket.send_str("checkpoint saved\n")
        return socket

    async def stop(request: web.Request) -> web.Response:
        calls.append(request.path)
        stopped.set()
        return web.json_response({"stopped": True})

    async def info(request: web.Request) -> web.Response:
        return web.json_response(job_info("STOPPED" if stopped.is_set() else "RUNNING"))

    written = []
    routes = version(), web.get("/api/jobs/j", info), web.get("/api/jobs/j/logs/tail", tail)
    with serving(*routes, web.post("/api/jobs/j/stop", stop)) as address:
        ending = JobServer(address).follow("j", lambda: "begun\n" in written, written.append, "stopping")
    assert written == ["begun\n", "stopping\n", "checkpoint saved\n"]
    assert calls == ["/api/jobs/j/stop"]
    assert ending.status == "STOPPED"


def test_attempts_are_those_of_the_name_in_numeric_order():
    async def jobs(request: web.Request) -> web.Response:
        ended = {"a-1": "FAILED", "a-10": "RUNNING", "a-2": "STOPPED", "a-b-3": "RUNNING", "other-4": "PENDING"}
        return web.json_response([{**job_info(status), "submission_id": key} for key, status in ended.items()])

    with serving(version(), web.get("/api/jobs/", jobs)) as address:
        assert JobServer(address).attempts("a") == [("a-1", True), ("a-2", True), ("a-10", False)]
