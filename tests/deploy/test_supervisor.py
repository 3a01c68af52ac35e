"""The supervisor, with small programs in the driver's place."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from deploy.supervisor import RESUMES, Reached, reached

PATIENCE_S = 120.0
SUPERVISE = "import sys; from pathlib import Path; from deploy.supervisor import Supervisor\n"
SUPERVISE += "sys.exit(Supervisor(Path(sys.argv[1]), [sys.executable, *sys.argv[2:]]).supervise())"
DRIVER = """
import json, os, signal, subprocess, sys, time
from pathlib import Path
run = Path(sys.argv[1])
starts = run / "starts.jsonl"
with starts.open("a") as file:
    print(json.dumps(sys.argv[2:]), file=file)
start = len(starts.read_text().splitlines())

def die(number=signal.SIGKILL):
    os.kill(os.getpid(), number)

def reach(env_steps):
    with (run / "metrics.jsonl").open("a") as file:
        print(json.dumps([env_steps, 0, {}]), file=file)
"""


@pytest.fixture
def supervised(tmp_path):
    """Starts the supervisor of a driver that does `what`."""
    made = []

    def start(what):
        driver = tmp_path / "driver.py"
        driver.write_text(f"{DRIVER}\n{what}\n")
        order = [sys.executable, "-c", SUPERVISE, str(tmp_path), str(driver), str(tmp_path), "--name", "r"]
        made.append(subprocess.Popen(order, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
        return made[-1]

    yield start
    for process in made:
        process.kill()
        process.communicate()


def starts(folder):
    return [json.loads(line) for line in (folder / "starts.jsonl").read_text().splitlines()]


def wait_for(path: Path) -> str:
    end_s = time.monotonic() + PATIENCE_S
    while not (path.exists() and path.read_text()):
        assert time.monotonic() < end_s
        time.sleep(0.02)
    return path.read_text()


@pytest.mark.parametrize("code", [0, 1, 2, 130])
def test_a_driver_that_ends_by_itself_is_the_end(supervised, tmp_path, code):
    process = supervised(f"print('told'); sys.exit({code})")
    assert process.communicate(timeout=PATIENCE_S) == ("told\n", "")
    assert process.returncode == code
    assert starts(tmp_path) == [["--name", "r"]]


def test_a_killed_driver_is_followed_by_one_that_resumes(supervised, tmp_path):
    process = supervised("reach(1000 * start)\nif start < 4: die(signal.SIGSEGV if start == 2 else signal.SIGKILL)")
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert starts(tmp_path) == [["--name", "r"]] + 3 * [["--name", "r", *RESUMES]]
    assert [line.split(";")[0] for line in said.splitlines()] == [
        "shoal: the driver was killed by SIGKILL at 1,000 env steps",
        "shoal: the driver was killed by SIGSEGV at 2,000 env steps",
        "shoal: the driver was killed by SIGKILL at 3,000 env steps",
    ]


@pytest.mark.parametrize("steps", ["reach(500)", "reach(500 if start == 1 else 400)", ""])
def test_a_driver_that_is_killed_twice_without_progress_is_given_up(supervised, tmp_path, steps):
    process = supervised(f"{steps}\ndie()")
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert len(starts(tmp_path)) == 2
    last = said.splitlines()[-1]
    assert "again without progress; find the cause, then `shoal resume" in last and str(tmp_path) in last


def test_steps_of_the_end_are_progress(supervised, tmp_path):
    made = 'end.mkdir(exist_ok=True); (end / "state.json").write_text(json.dumps({"made": ["a"] * start}))'
    process = supervised(f"end = run / 'end'; reach(500); {made}\nif start < 4: die()")
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert len(starts(tmp_path)) == 4


def test_nothing_of_a_killed_driver_is_left(supervised, tmp_path):
    sleeps = "[sys.executable, '-c', 'import time; time.sleep(1000)']"
    process = supervised(f"""
if start == 1:
    left = subprocess.Popen({sleeps}, start_new_session=True)
    os.kill(left.pid, signal.SIGSTOP)
    (run / "left").write_text(str(left.pid))
    die()
left = int((run / "left").read_text())
sys.exit(3 if os.path.exists(f"/proc/{{left}}") else 0)
""")
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert len(starts(tmp_path)) == 2


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_is_passed_on_and_so_is_the_exit_code(supervised, tmp_path, number):
    process = supervised(f"""
signal.signal({int(number)}, lambda number, frame: sys.exit(128 + number))
(run / "ready").write_text("yes")
time.sleep(1000)
""")
    wait_for(tmp_path / "ready")
    process.send_signal(number)
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 128 + number
    assert len(starts(tmp_path)) == 1


def test_a_driver_that_dies_of_a_signal_that_was_passed_on_is_not_followed(supervised, tmp_path):
    process = supervised('(run / "ready").write_text("yes"); time.sleep(1000)')
    wait_for(tmp_path / "ready")
    process.terminate()
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 128 + signal.SIGTERM
    assert len(starts(tmp_path)) == 1


def test_a_driver_ends_with_its_supervisor(supervised, tmp_path):
    process = supervised("""
signal.signal(signal.SIGTERM, lambda number, frame: ((run / "told").write_text("to end"), sys.exit(0)))
(run / "pid").write_text(str(os.getpid()))
time.sleep(1000)
""")
    driver = psutil.Process(int(wait_for(tmp_path / "pid")))
    process.kill()
    assert wait_for(tmp_path / "told") == "to end"
    driver.wait(PATIENCE_S)


def test_the_supervisor_is_small():
    code = "import deploy.supervisor, sys, json; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"numpy", "tyro", "gymnasium", "sim_core", "actors"} & set(json.loads(done.stdout))


def test_how_far_a_run_is(tmp_path):
    assert reached(tmp_path) == Reached(0, 0)
    (tmp_path / "metrics.jsonl").write_text('[100, 5, {}]\n[200, 6, {"a": 1.0}]\n[300, 7')
    assert reached(tmp_path) == Reached(0, 200)
    (tmp_path / "end").mkdir()
    (tmp_path / "end" / "state.json").write_text('{"made": []}')
    assert Reached(0, 10**9) < reached(tmp_path) == Reached(1, 200)
    (tmp_path / "metrics.jsonl").write_text("damaged\n")
    assert reached(tmp_path) == Reached(1, 0)


def test_supervisor_and_driver_are_of_the_shoal_that_began(tmp_path):
    """A folder `deploy` where the user stands is somebody else's, unless `python -m deploy` has taken it."""
    other = tmp_path / "deploy"
    other.mkdir()
    (other / "__init__.py").write_text("raise SystemExit('somebody else')")
    script = tmp_path / "bin" / "shoal"
    script.parent.mkdir()
    script.write_text("import sys\nfrom deploy.cli import main\nsys.exit(main())")
    order = [sys.executable, str(script), "train", "--supervise", "--name", "greedy", "--engine", "process"]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    ended = subprocess.run(order, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=PATIENCE_S)
    assert (ended.returncode, ended.stderr) == (2, "shoal: --name greedy is that of a baseline; choose another\n")
