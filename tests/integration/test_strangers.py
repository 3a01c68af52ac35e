"""A cluster that listens on a network: who has no token submits nothing, and who is no machine of it reads nothing.

Three network namespaces are three machines: one runs Ray's head behind the firewall that we give, one belongs to the
cluster, one is a stranger's.
"""

import json
import re
import secrets
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.integration.jobs import kill
from tests.integration.machines import at, connect, machines, on, root
from tests.integration.ray_head import ROOT, copy_of_the_code, ray_start, short_folder, with_token

pytestmark = [pytest.mark.ray, pytest.mark.slow]

FIREWALL = ROOT / "deploy" / "firewall.nft"
HEAD, MEMBER, GATE, STRANGER = "10.77.1.1", "10.77.1.2", "10.77.2.1", "10.77.2.2"
METRICS, DASHBOARD = 8080, 8265
LISTENING = """
import json, psutil
found = [each.laddr for each in psutil.net_connections("tcp") if each.status == "LISTEN"]
print(json.dumps(sorted({place.port for place in found if not place.ip.startswith(("127.", "::1", "::ffff:127."))})))
"""
OPEN = """
import json, socket, sys
def is_open(port):
    try:
        socket.create_connection((sys.argv[1], port), 1).close()
        return True
    except OSError:
        return False
print(json.dumps([port for port in map(int, sys.argv[2:]) if is_open(port)]))
"""
READ = "import sys, urllib.request; print(urllib.request.urlopen(sys.argv[1], timeout=20).read().decode())"


class Machines(NamedTuple):
    """Names of the three."""

    head: str
    member: str
    stranger: str


def python(machine: str, program: str, *arguments: object):
    done = on(machine, sys.executable, "-c", program, *map(str, arguments))
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def trio() -> Iterator[Machines]:
    if not shutil.which("nft"):
        pytest.skip("needs nftables")
    with machines("head", "member", "stranger") as names:
        made = Machines(*names)
        connect(made.head, HEAD, made.member, MEMBER)
        connect(made.head, GATE, made.stranger, STRANGER)
        root("ip", "-n", made.stranger, "route", "add", "10.77.1.0/24", "via", GATE)
        yield made


@pytest.fixture(scope="module")
def token(trio) -> Iterator[str]:
    """The token of a head that listens on all interfaces, before its firewall stands."""
    secret = secrets.token_hex(32)
    words = ["--head", f"--node-ip-address={HEAD}", "--dashboard-host=0.0.0.0", "--num-cpus=1"]
    words += [f"--metrics-export-port={METRICS}", f"--dashboard-port={DASHBOARD}"]
    with short_folder() as folder:
        log = folder / "log"
        process = ray_start(log, *words, f"--temp-dir={folder}", auth=with_token(secret), before=at(trio.head))
        assert process.poll() is None, log.read_text()
        yield secret
        kill(process)


@pytest.fixture
def firewall(trio, tmp_path) -> Iterator[None]:
    """What we give, with the addresses of these machines in it."""
    text, count = re.subn(r"(define machines = ){.*}", rf"\1{{ {HEAD}, {MEMBER} }}", FIREWALL.read_text())
    assert count == 1
    (tmp_path / "firewall.nft").write_text(text)
    for _ in range(2):  # once more over itself, as an operator does
        done = on(trio.head, "nft", "-f", str(tmp_path / "firewall.nft"))
        assert done.returncode == 0, done.stderr
    yield
    on(trio.head, "nft", "delete", "table", "inet", "shoal")


def test_a_stranger_finds_no_open_port_behind_the_firewall(trio, token, firewall):
    ports = json.loads(python(trio.head, LISTENING))
    assert {METRICS, DASHBOARD, 6379} <= set(ports)
    assert json.loads(python(trio.member, OPEN, HEAD, *ports)) == ports
    assert json.loads(python(trio.stranger, OPEN, HEAD, *ports)) == []
    assert "ray_node_cpu_count" in python(trio.member, READ, f"http://{HEAD}:{METRICS}/metrics")


def test_without_the_firewall_anybody_reads_the_metrics(trio, token):
    """Why there is one: a Ray that asks for a token gives its metrics without."""
    assert "ray_node_cpu_count" in python(trio.stranger, READ, f"http://{HEAD}:{METRICS}/metrics")


@pytest.mark.parametrize("shown", ["none", "another"])
@pytest.mark.parametrize("words", ["shoal submit", "ray job submit"])
def test_a_job_without_the_token_is_refused(words, shown, trio, token, tmp_path):
    """By the token alone, with no firewall in between."""
    checkout = copy_of_the_code(tmp_path / "checkout")
    auth = {"HOME": str(tmp_path), "PYTHONPATH": str(checkout), "RAY_AUTH_MODE": "disabled"}
    if shown == "another":
        auth |= with_token(secrets.token_hex(32))
    place = ["--address", f"http://{HEAD}:{DASHBOARD}"]
    if words == "shoal submit":
        command = [sys.executable, "-m", "deploy", "submit", *place, "train", "--runs-dir", str(tmp_path / "runs")]
    else:
        command = [
            str(Path(sys.executable).parent / "ray"),
            "job",
            "submit",
            *place,
            "--",
            "touch",
            str(tmp_path / "t"),
        ]
    done = on(trio.member, *command, auth=auth, cwd=checkout)
    assert done.returncode != 0
    if words == "shoal submit":
        assert done.returncode == 2 and "Traceback" not in done.stderr, done.stderr
        assert "RAY_AUTH_TOKEN" in done.stderr.splitlines()[-1]
    asked = [str(Path(sys.executable).parent / "ray"), "job", "list", *place]
    listed = on(trio.member, *asked, auth=with_token(token))
    assert listed.returncode == 0, listed.stderr
    assert "submission_id" not in listed.stdout, listed.stdout
    assert not (tmp_path / "t").exists() and not (tmp_path / "runs").exists()
