"""A Ray of our own leaves nothing behind, not even a process that hangs in its own end."""

import os
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

pytestmark = pytest.mark.ray

SCRIPT = """
import atexit, os, time
from learner.ray_backend.auth import guard_ray
guard_ray(joins=False)
import ray
from learner.ray_backend.cluster import connect, leave

class Part:
    def pid(self):
        atexit.register(time.sleep, 600)
        return os.getpid()

connect(2, None)
parts = [ray.remote(num_cpus=1)(Part).remote() for _ in range(2)]
print(*ray.get([part.pid.remote() for part in parts]))
print(os.path.dirname(ray._private.worker._global_node.get_session_dir_path()))
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


def test_a_process_that_hangs_does_not_outlive_our_own_ray(tmp_path):
    """Ray starts although TMPDIR is too long for a socket's path, and its folder goes with it."""
    before = set(Path("/tmp").glob("shoal-ray-*"))
    env = os.environ | {"TMPDIR": str(tmp_path / ("x" * 100))}
    env.pop("RAY_TMPDIR", None)
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stderr
    (folder,) = map(Path, done.stdout.splitlines()[1:])
    assert folder.name.startswith("shoal-ray-") and not folder.exists() and folder not in before
    assert [has_gone(int(pid)) for pid in done.stdout.splitlines()[0].split()] == [True, True]
