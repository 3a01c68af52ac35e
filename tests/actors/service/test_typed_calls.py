"""A type checker refuses calls of nodes that could not work, and knows the results of those that can."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]

SNIPPET = """# mypy: disable-error-code=empty-body
from typing import Protocol

from actors.service.rpc import Calls, Handle, LocalCalls, Placed, Ref, by_reference, local_handle


class Adds(Protocol):
    def add(self, number: int) -> float: ...


class Shard:
    def add(self, number: int) -> float: ...
    def draw(self, count: int, scale: float = 1.0) -> list[str]: ...
    def size(self) -> int: ...


class Learner:
    def add(self, number: int) -> float: ...
    def learn(self, weights: bytes) -> None: ...


def count(rows: list[str], most: int) -> int: ...


def use(calls: Calls, shard: Handle[Shard], learner: Handle[Learner], weights: Ref[bytes]) -> None:
    rows: list[str] = calls.get(calls.start(shard, Shard.draw, 3))
    calls.start(shard, Shard.draw, 3, 0.5)
    calls.start(shard, Shard.size)
    targets: list[Handle[Adds]] = [shard, learner]
    total: float = calls.get(calls.start(targets[0], Adds.add, 3))
    calls.start(learner, Learner.learn, by_reference(weights))
    number: int = calls.get(calls.run(count, by_reference(calls.start(shard, Shard.draw, 3)), 7))
    calls.start(local_handle(Shard()), Shard.size)
    other: Calls = LocalCalls()

    calls.start(shard, Shard.drow, 3)  # wrong: misspelt
    calls.start(shard, "draw", 3)  # wrong: a name
    calls.start(shard, Shard.draw, "3")  # wrong: type of an argument
    calls.start(shard, Shard.draw)  # wrong: an argument is missing
    calls.start(shard, Shard.size, 3)  # wrong: an argument too many
    calls.start(shard, Learner.learn, b"")  # wrong: method of another node
    calls.start(targets[0], Shard.size)  # wrong: not all targets have it
    calls.start(learner, Learner.learn, weights)  # wrong: a reference that is not marked as one
    columns: dict[str, int] = calls.get(calls.start(shard, Shard.draw, 3))  # wrong: type of the result
    calls.run(count, rows, "7")  # wrong: type of an argument
    shard.draw(3)  # wrong: the node may be in another process
    mixed: Handle[Shard] = learner  # wrong: another node
"""


def test_wrong_calls_are_refused_and_right_ones_pass(tmp_path):
    file = tmp_path / "snippet.py"
    file.write_text(SNIPPET)
    command = [sys.executable, "-m", "mypy", file]  # in the project's folder, for its settings and its cache
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    refused = {int(line) for line in re.findall(r"snippet\.py:(\d+): error", done.stdout)}
    lines = SNIPPET.splitlines()
    wrong = {number for number, line in enumerate(lines, 1) if "# wrong" in line}
    assert len(wrong) == 12
    assert refused == wrong, done.stdout + done.stderr
