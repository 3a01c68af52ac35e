"""A Ray of our own starts no process that a run does not need, and leaves none behind, not even one that hangs."""

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import psutil
import pytest

pytestmark = pytest.mark.ray

SCRIPT = """
import atexit, os, time
from pathlib import Path
import psutil
from learner.ray_backend.auth import guard_ray
guard_ray(joins=False)
import ray
from learner.ray_backend.cluster import connect, leave

class Part:
    def pid(self):
        atexit.register(time.sleep, 600)
        return os.getpid()

os.cpu_count = lambda: 8
connect(2, None)
parts = [ray.remote(num_cpus=1)(Part).remote() for _ in range(2)]
print(*ray.get([part.pid.remote() for part in parts]))
print(os.path.dirname(ray._private.worker._global_node.get_session_dir_path()))
orders = [process.cmdline() for process in psutil.Process().children(recursive=True)]
print(*(Path(next((word for word in order if word.endswith(".py")), order[0])).name for order in orders if order))
del parts[0]  # Ray asks it to go, and takes it for gone
time.sleep(2)
leave()
assert not ray.is_initialized()
"""


def has_gone(pid):
    """Whether a process ends within a minute, before it would end by itself."""
    try:
        psutil.Process(pid).wait(timeout=60)
    except psutil.TimeoutExpired:
        return False
    except psutil.NoSuchProcess:
        pass
    return True


def test_our_own_ray_has_what_a_run_needs_and_no_process_outlives_it(tmp_path):
    """Ray starts although TMPDIR is too long for a socket's path, and its folder goes with it.

    Of eight slots two are taken, and two worker processes start; the autoscaler and the dashboard's server do not.
    """
    before = set(Path("/tmp").glob("shoal-ray-*"))
    env = os.environ | {"TMPDIR": str(tmp_path / ("x" * 100))}
    env.pop("RAY_TMPDIR", None)
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stderr
    pids, folder, names = done.stdout.splitlines()
    started = Counter(names.split())
    assert started["ray::Part"] == 2 and started["gcs_server"] == started["raylet"] == started["log_monitor.py"] == 1
    assert not started.keys() & {"dashboard.py", "monitor.py", "ray::IDLE", "default_worker.py"}
    folder = Path(folder)
    assert folder.name.startswith("shoal-ray-") and not folder.exists() and folder not in before
    assert [has_gone(int(pid)) for pid in pids.split()] == [True, True]
