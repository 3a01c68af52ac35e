"""What a process prints may be refused; the process goes on, and no file takes the number of a closed stream."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import sys
from deploy.console.streams import outlive_streams, prepare_streams
prepare_streams()
outlive_streams()
opened = open(sys.argv[1], "w")
for _ in range(1_000):
    print("10r×2g", "▸" * 50)
    print("10r×2g", file=sys.stderr)
sys.stdout.flush()
opened.write(str(opened.fileno()))
opened.close()
"""


def run(path: Path, words: str, **environment: str) -> subprocess.CompletedProcess:
    """The program, run by a shell that redirects its output as `words` say."""
    line = f'{sys.executable} -W error -c "$PROGRAM" {path} {words}'
    env = {**os.environ, "PROGRAM": PROGRAM, **environment}
    return subprocess.run(["bash", "-o", "pipefail", "-c", line], env=env, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    "words", ["> /dev/full", "2> /dev/full", ">&- 2>&-", "<&- >&- 2>&-", "| head -1", "|& head -1", "> /dev/full 2>&1"]
)
def test_a_process_outlives_what_it_prints_to(tmp_path, words):
    done = run(tmp_path / "file", words)
    assert done.returncode == 0 and "Traceback" not in done.stderr and "Exception ignored" not in done.stderr
    assert int((tmp_path / "file").read_text()) > 2, "no file has the number of a stream"


def test_it_says_once_that_nobody_takes_its_output(tmp_path):
    done = run(tmp_path / "file", "> /dev/full", PYTHONIOENCODING="utf-8")
    line = "shoal: standard output takes nothing (No space left on device); going on without it\n"
    assert done.stderr.count(line) == 1


def test_signs_that_an_encoding_lacks_are_replaced(tmp_path):
    done = run(tmp_path / "file", "", PYTHONIOENCODING="ascii")
    assert done.returncode == 0 and done.stdout.startswith("10r?2g ??")
