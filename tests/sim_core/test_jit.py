"""Compiled kernels are kept on disk, never outlive the sources that they were compiled from, and cannot allocate."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core.errors import NumbaError

import sim_core
from sim_core import jit
from sim_core.jit import inlined, kernel

ROOT = Path(sim_core.__file__).parents[1]

START = """
import numba
before = numba.config.CACHE_DIR
import numpy as np
from sim_core.config import WorldConfig
from sim_core.scenes.circle import circle_params, start_world
from sim_core.state import empty_state

state = empty_state(WorldConfig(), 1, np.float64)
state.rng[0] = 1
start_world(0, state, circle_params(WorldConfig()))
print(state.pos_x.sum() + state.pos_y.sum(), numba.config.CACHE_DIR == before)
"""


def start(folder):
    """What the sources in `folder` say in a new process: (sum of a world's start positions, setting untouched)."""
    env = os.environ | {"PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(folder / "cache")}
    done = subprocess.run(
        [sys.executable, "-c", START], cwd=folder, env=env, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    total, untouched = done.stdout.split()
    return float(total), untouched == "True"


def kept(folder):
    """Files of compiled kernels, by the folder of the sources' version."""
    files = [path for path in (folder / "cache").rglob("*.nb?")]
    assert all(path.relative_to(folder / "cache").parts[0].startswith("kernels-") for path in files)
    return {path: path.stat().st_mtime_ns for path in files}


def change(source, pattern, value):
    """Writes `value` in the place of the one text in a source that matches `pattern`."""
    changed, count = re.subn(pattern, value, source.read_text())
    assert count == 1
    source.write_text(changed)


def test_kernels_follow_changes_of_any_source(tmp_path):
    shutil.copytree(ROOT / "sim_core", tmp_path / "sim_core", ignore=shutil.ignore_patterns("__pycache__"))
    first = start(tmp_path)
    compiled = kept(tmp_path)
    assert compiled and start(tmp_path) == first and kept(tmp_path) == compiled  # nothing compiled anew
    change(tmp_path / "sim_core" / "rng.py", r"(?<=_MIX_1 = np.uint64\()0xBF58476D1CE4E5B9", "0xBF58476D1CE4E5BB")
    second = start(tmp_path)  # the kernel is in circle.py, which is as it was
    assert second[0] != first[0]
    assert first[1] and second[1]
    both = kept(tmp_path)
    assert compiled.items() < both.items() and len(both) == 2 * len(compiled)


def test_kernels_follow_changes_of_the_neighbours_that_have_kernels(tmp_path):
    for package in ("sim_core", *jit.NEIGHBOURS):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    start(tmp_path)
    for name, follows in (
        ("actors/policy/mlp_kernels.py", True),
        ("learner/update/compiled_updates.py", True),
        ("actors/service/rpc.py", False),
    ):
        before = len(list((tmp_path / "cache").iterdir()))
        with (tmp_path / name).open("a") as source:
            source.write("# changed\n")
        start(tmp_path)
        assert len(list((tmp_path / "cache").iterdir())) == before + follows


def test_other_users_of_numba_keep_their_setting(monkeypatch):
    for setting in ("", "/nowhere/cache"):
        monkeypatch.setattr(numba.config, "CACHE_DIR", setting)
        kernel(lambda x: x + 1)
        inlined(lambda x: x + 1)
        with pytest.raises(TypeError):
            kernel(3)
        assert numba.config.CACHE_DIR == setting


def test_kernels_are_kept_beside_the_sources_or_in_the_users_cache(monkeypatch, tmp_path):
    package = ROOT / "sim_core"
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setattr(jit.os, "access", lambda path, mode: True)
    assert Path(jit._cache_folder()).parent == package / "__pycache__"
    monkeypatch.setattr(jit.os, "access", lambda path, mode: False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert Path(jit._cache_folder()).parent == tmp_path / "shoal"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert Path(jit._cache_folder()).parent == Path.home() / ".cache" / "shoal"
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    assert Path(jit._cache_folder()).parent == tmp_path


def _makes_an_array(x):
    return np.zeros(3)[0] + x


def _makes_an_empty_array(x):
    made = np.empty(3)
    made[0] = x
    return made[0]


def _makes_a_list(x):
    return [x, x][0]


def _copies(x):
    return np.full(3, x).copy()


def _adds_arrays(x):
    return (x + x)[0]


@pytest.mark.parametrize(
    "function, argument",
    [
        (_makes_an_array, 1.0),
        (_makes_an_empty_array, 1.0),
        (_makes_a_list, 1.0),
        (_copies, 1.0),
        (_adds_arrays, np.ones(3)),
    ],
)
def test_a_kernel_that_allocates_is_refused(function, argument):
    with pytest.raises(NumbaError):
        kernel(function)(argument)


def test_division_by_zero_is_that_of_ieee():
    divide = kernel(lambda x, y: x / y)
    assert divide(1.0, 0.0) == np.inf and np.isnan(divide(0.0, 0.0))
