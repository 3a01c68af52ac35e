"""The benchmark beside other simulators: its turns, and who is left out."""

import io
import sys

import pytest
from rich.console import Console

from tests.benchmarks.robot_contenders import ours
from tests.benchmarks.robot_contenders.turns import MARK, TURN_S, Job
from tests.benchmarks.robot_peers import OTHERS, OURS, VMAS, Contender, Field, Running, parse


def field(*arguments):
    """(the field, what is said of those left out)."""
    said = io.StringIO()
    return Field(parse(list(arguments)), Console(file=said, width=200)), said.getvalue()


def test_ours_counts_robots_that_decided():
    step = ours.make(Job("sensor", 10, 3))
    counts = [step() for _ in range(300)]
    assert 0 < min(counts) < max(counts) <= 30  # a robot whose episode has ended waits for its world


def test_a_contender_takes_turns_in_a_process_of_its_own():
    with Running(OURS[0], sys.executable, None, Job("sensor", 10, 4)) as running:
        turns = [running(), running()]
    assert all(turn.units > 0 and TURN_S <= turn.seconds < 2 * TURN_S for turn in turns)


def test_a_contender_that_fails_says_why():
    broken = Contender("broken", "ours", "sensor", ("", ""), "", (1,))
    with (
        pytest.raises(RuntimeError, match="KeyError: 7"),
        Running(broken, sys.executable, None, Job("sensor", 7, 1)) as run,
    ):
        run()


def test_lines_that_a_library_prints_are_no_turns(tmp_path, monkeypatch):
    (tmp_path / "python").write_text(f"#!/bin/sh\nread line\necho turning up\necho {MARK} 12 0.5\nread line\n")
    (tmp_path / "python").chmod(0o700)
    with Running(OURS[0], str(tmp_path / "python"), None, Job("sensor", 10, 4)) as running:
        assert running() == (12, 0.5)


def test_peers_that_are_not_there_are_left_out_with_a_sentence(tmp_path):
    found, said = field()
    assert found.contenders == list(OURS)
    assert said.count("left out") == len(VMAS + OTHERS) and "no --peers PYTHON with camar" in said
    bare = tmp_path / "python"
    bare.write_text("#!/bin/sh\nexit 1\n")  # what looks for a package fails
    bare.chmod(0o700)
    found, said = field("--vmas", str(tmp_path), "--peers", str(bare))
    assert found.contenders == list(OURS) and f"{bare} has no ir-sim" in said


def test_a_process_has_as_many_robots_as_a_batch():
    assert OURS[0].worlds(40) == [64, 1024]
    assert OTHERS[0].worlds(200) == [1, 12] and OTHERS[-1].worlds(200) == [1]
