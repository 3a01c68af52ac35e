"""Compiled kernels are cached on disk, are compiled anew when a source changes, and cannot allocate memory."""

import inspect
import os
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core.errors import NumbaError

import sim_core
from sim_core import jit
from sim_core.jit import LockedCacheFile, inlined, kernel

ROOT = Path(sim_core.__file__).parents[1]

START_A_WORLD = """
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


def start_a_world(folder):
    """Runs the sources in `folder` in a new process: (sum of the start positions, whether CACHE_DIR is unchanged)."""
    env = os.environ | {"PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(folder / "cache")}
    done = subprocess.run(
        [sys.executable, "-c", START_A_WORLD], cwd=folder, env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    total, unchanged = done.stdout.split()
    return float(total), unchanged == "True"


def cached(folder):
    """Modification times of the files in the cache folders."""
    files = [path for path in (folder / "cache").rglob("*.nb?")]
    assert all(path.relative_to(folder / "cache").parts[0].startswith("kernels-") for path in files)
    return {path: path.stat().st_mtime_ns for path in files}


def copy_packages(folder, *names):
    for name in names:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))


def replace(source, pattern, value):
    """Replaces the only match of `pattern` in a source by `value`."""
    changed, count = re.subn(pattern, value, source.read_text())
    assert count == 1
    source.write_text(changed)


def append_a_comment(source):
    with source.open("a") as file:
        file.write("# changed\n")


def test_kernels_are_compiled_anew_when_an_inlined_kernel_of_another_file_changes(tmp_path):
    copy_packages(tmp_path, "sim_core")
    first = start_a_world(tmp_path)
    compiled = cached(tmp_path)
    assert compiled and start_a_world(tmp_path) == first and cached(tmp_path) == compiled  # nothing was compiled anew
    replace(tmp_path / "sim_core" / "rng.py", r"(?<=_MIX_1 = np.uint64\()0xBF58476D1CE4E5B9", "0xBF58476D1CE4E5BB")
    second = start_a_world(tmp_path)  # calls a kernel in scenes/circle.py, which has not changed
    assert second[0] != first[0]
    assert first[1] and second[1]
    both = cached(tmp_path)
    assert compiled.items() < both.items() and len(both) == 2 * len(compiled)


def test_a_changed_kernel_in_a_subfolder_of_any_package_starts_another_cache_folder(tmp_path):
    copy_packages(tmp_path, "sim_core", *jit.KERNEL_PACKAGES)
    start_a_world(tmp_path)
    for name, has_kernels in (
        ("sim_core/swarm/neighbours.py", True),
        ("actors/policy/mlp_kernels.py", True),
        ("learner/update/compiled_updates.py", True),
        ("actors/service/rpc.py", False),
    ):
        before = len(list((tmp_path / "cache").iterdir()))
        append_a_comment(tmp_path / name)
        start_a_world(tmp_path)
        assert len(list((tmp_path / "cache").iterdir())) == before + has_kernels


def test_the_cache_folder_depends_on_every_source_with_kernels(monkeypatch, tmp_path):
    """The sources are found by the decorators in their text. Users' own methods, like deploy/examples, are plug-ins."""
    copy_packages(tmp_path, "sim_core", "actors", "learner", "deploy", "dashboards")
    shutil.rmtree(tmp_path / "deploy" / "examples")
    functions = inspect.getmembers(jit, lambda value: inspect.isfunction(value) and value.__module__ == jit.__name__)
    decorators = [name for name, _ in functions if not name.startswith("_")]
    decorated = re.compile(rf"^@({'|'.join(decorators)})$", re.MULTILINE)
    sources = [path for path in sorted(tmp_path.rglob("*.py")) if decorated.search(path.read_text())]
    in_subfolders = [path.relative_to(tmp_path).parts[0] for path in sources if path.parents[1] != tmp_path]
    assert set(in_subfolders) == {"sim_core", *jit.KERNEL_PACKAGES}
    assert len(sources) > len(in_subfolders)  # sim_core has kernels outside subfolders, too
    monkeypatch.setattr(jit, "__file__", str(tmp_path / "sim_core" / "jit.py"))
    folders = {jit._cache_folder()}
    for count, source in enumerate(sources, start=2):
        append_a_comment(source)
        folders.add(jit._cache_folder())
        assert len(folders) == count, source


def test_plugins_in_the_cache_folder_do_not_change_it(monkeypatch, tmp_path):
    copy_packages(tmp_path, "sim_core", *jit.KERNEL_PACKAGES)
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setattr(jit, "__file__", str(tmp_path / "sim_core" / "jit.py"))
    folder = Path(jit._cache_folder())
    assert tmp_path in folder.parents
    plugin = folder / "plugins" / "0123456789abcdef" / "my_method.py"
    plugin.parent.mkdir(parents=True)
    plugin.write_text("from sim_core.jit import kernel\n")
    assert Path(jit._cache_folder()) == folder


def test_other_users_of_numba_keep_their_cache_folder(monkeypatch):
    for setting in ("", "/some/cache"):
        monkeypatch.setattr(numba.config, "CACHE_DIR", setting)
        kernel(lambda x: x + 1)
        inlined(lambda x: x + 1)
        with pytest.raises(TypeError):
            kernel(3)
        assert numba.config.CACHE_DIR == setting


def test_kernels_are_cached_beside_the_sources_or_in_the_users_cache(monkeypatch, tmp_path):
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


def test_signatures_that_are_saved_at_once_keep_their_own_code(tmp_path):
    def save(i):
        LockedCacheFile(str(tmp_path), "kernel", "stamp").save(f"signature {i}", f"code {i}")

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(save, range(100)))
    cache = LockedCacheFile(str(tmp_path), "kernel", "stamp")
    assert [cache.load(f"signature {i}") for i in range(100)] == [f"code {i}" for i in range(100)]


def test_kernels_are_saved_under_the_lock():
    for made in (kernel(lambda x: x + 1), inlined(lambda x: x + 1)):
        assert type(made._cache._cache_file) is LockedCacheFile


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


def test_division_by_zero_follows_ieee_754():
    divide = kernel(lambda x, y: x / y)
    assert divide(1.0, 0.0) == np.inf and np.isnan(divide(0.0, 0.0))
