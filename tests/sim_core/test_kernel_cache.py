"""Compiled kernels are kept by the content of their sources; a cache that fails stops nobody."""

import inspect
import os
import re
import resource
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numba
import pytest

import sim_core
from sim_core import jit, kernel_cache
from sim_core.jit import inlined, kernel
from sim_core.kernel_cache import CheckedCacheFile

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


def start_a_world(folder, caches=None):
    """Runs the sources in `folder` in a new process: (sum of the start positions, whether CACHE_DIR is unchanged)."""
    env = os.environ | {"PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str((caches or folder) / "cache")}
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
    copy_packages(tmp_path, "sim_core", *kernel_cache.KERNEL_PACKAGES)
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
    assert set(in_subfolders) == {"sim_core", *kernel_cache.KERNEL_PACKAGES}
    assert len(sources) > len(in_subfolders)  # sim_core has kernels outside subfolders, too
    monkeypatch.setattr(kernel_cache, "__file__", str(tmp_path / "sim_core" / "kernel_cache.py"))
    folders = {kernel_cache.sources_digest()}
    for count, source in enumerate(sources, start=2):
        append_a_comment(source)
        folders.add(kernel_cache.sources_digest())
        assert len(folders) == count, source


def test_plugins_beside_the_sources_do_not_change_it(monkeypatch, tmp_path):
    copy_packages(tmp_path, "sim_core", *kernel_cache.KERNEL_PACKAGES)
    monkeypatch.setattr(kernel_cache, "__file__", str(tmp_path / "sim_core" / "kernel_cache.py"))
    before = kernel_cache.sources_digest()
    plugin = tmp_path / "sim_core" / "__pycache__" / f"kernels-{before}" / "plugins" / "0123456789abcdef" / "mine.py"
    plugin.parent.mkdir(parents=True)
    plugin.write_text("from sim_core.jit import kernel\n")
    assert kernel_cache.sources_digest() == before


def test_copies_of_the_sources_share_their_kernels(tmp_path):
    """As the copies do that Ray makes of a job's code."""
    one, other = tmp_path / "one", tmp_path / "other"
    copy_packages(one, "sim_core")
    copy_packages(other, "sim_core")
    first = start_a_world(one, tmp_path)
    compiled = cached(tmp_path)
    assert start_a_world(other, tmp_path) == first and cached(tmp_path) == compiled


def _doubles(x):
    return x + x


@pytest.fixture
def cache(monkeypatch, tmp_path):
    """A cache folder of the test's own."""
    monkeypatch.setattr(kernel_cache, "CACHE_FOLDER", str(tmp_path))
    kernel_cache._say.cache_clear()
    return tmp_path


DAMAGES = {
    "cut to half": lambda content: content[: len(content) // 2],
    "cut by one byte": lambda content: content[:-1],
    "empty": lambda content: b"",
    "zeros": lambda content: bytes(len(content)),
    "text": lambda content: b"no cache",
    "one bit": lambda content: content[:-40] + bytes([content[-40] ^ 1]) + content[-39:],
    "made by numba alone": lambda content: content[:-32],
}


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_cache_heals_itself(cache, suffix, damage):
    assert kernel(_doubles)(2.0) == 4.0
    (path,) = cache.rglob(f"*.{suffix}")
    whole = path.read_bytes()
    path.write_bytes(DAMAGES[damage](whole))
    made = kernel(_doubles)
    assert made(2.0) == 4.0 and not made.stats.cache_hits
    again = kernel(_doubles)
    assert again(2.0) == 4.0 and sum(again.stats.cache_hits.values()) == 1
    assert len(list(cache.rglob("*.nb?"))) == 2


def test_a_cached_file_that_cannot_be_unpickled_or_linked_is_compiled_anew(cache, monkeypatch):
    assert kernel(_doubles)(2.0) == 4.0
    for error in (AttributeError("a class of another version"), RuntimeError("no such symbol"), PermissionError()):
        with monkeypatch.context() as patch:
            patch.setattr(CheckedCacheFile, "_load_data", lambda self, name, error=error: (_ for _ in ()).throw(error))
            made = kernel(_doubles)
            assert made(2.0) == 4.0 and not made.stats.cache_hits


def test_kernels_that_cannot_be_saved_are_used_without_which_is_said_once(cache, capsys):
    """The system refuses every byte that this process writes to a file, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
    try:
        results = [kernel(_doubles)(2.0), kernel(_doubles)(2.0), kernel(_doubles)(2)]
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert results == [4.0, 4.0, 4]
    assert capsys.readouterr().err.count("cannot be kept") == 1
    assert kernel(_doubles)(2.0) == 4.0 and list(cache.rglob("*.nbc"))


def test_other_users_of_numba_keep_their_cache_folder(monkeypatch):
    for setting in ("", "/some/cache"):
        monkeypatch.setattr(numba.config, "CACHE_DIR", setting)
        kernel(lambda x: x + 1)
        inlined(lambda x: x + 1)
        with pytest.raises(TypeError):
            kernel(3)
        assert numba.config.CACHE_DIR == setting


def test_the_first_folder_that_can_be_written_keeps_the_kernels(monkeypatch, tmp_path, capsys):
    """Numba's own setting, the user's cache folder, beside the sources, the folder for temporary files."""
    file = tmp_path / "file"
    file.write_text("no folder can be made in a file")
    own, home, sources, temporary = (tmp_path / name for name in ("own", "home", "sources", "temporary"))
    temporary.mkdir()
    monkeypatch.setattr(kernel_cache, "sources_digest", lambda: "0")
    monkeypatch.setattr(kernel_cache, "__file__", str(sources / "kernel_cache.py"))
    monkeypatch.setattr(kernel_cache.tempfile, "tempdir", str(temporary))
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(own))
    monkeypatch.setenv("XDG_CACHE_HOME", str(home))
    assert kernel_cache.cache_folder() == str(own / "kernels-0")
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(file))
    assert kernel_cache.cache_folder() == str(home / "shoal" / "kernels-0")
    monkeypatch.setenv("XDG_CACHE_HOME", str(file))
    assert kernel_cache.cache_folder() == str(sources / "__pycache__" / "kernels-0")
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(kernel_cache, "__file__", str(file / "kernel_cache.py"))
    users = temporary / f"shoal-{os.getuid()}"
    assert kernel_cache.cache_folder() == str(users / "kernels-0")
    assert f"compiled kernels are kept in {users}" in capsys.readouterr().err
    assert kernel_cache.cache_folder() == str(users / "kernels-0")
    assert capsys.readouterr().err == "", "once is enough"
    assert users.stat().st_mode & 0o777 == 0o700, "nobody else puts code there"


def test_a_folder_that_others_can_write_code_to_is_not_used(monkeypatch, tmp_path):
    monkeypatch.setattr(kernel_cache.tempfile, "tempdir", str(tmp_path))
    folder = tmp_path / f"shoal-{os.getuid()}"
    assert kernel_cache._temporary_folder() == folder
    folder.chmod(0o777)
    assert kernel_cache._temporary_folder() is None
    folder.rmdir()
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    folder.symlink_to(tmp_path / "elsewhere")
    assert kernel_cache._temporary_folder() is None


def test_where_nothing_can_be_written_kernels_are_compiled_all_the_same(cache, monkeypatch, capsys):
    def nowhere():
        raise FileNotFoundError("no usable temporary directory")

    monkeypatch.setattr(kernel_cache, "_is_usable", lambda folder: False)
    monkeypatch.setattr(kernel_cache.tempfile, "gettempdir", nowhere)
    folder = kernel_cache.cache_folder()
    (cache / "in the way").write_text("no folder can be made in a file")
    monkeypatch.setattr(kernel_cache, "CACHE_FOLDER", str(cache / "in the way" / Path(folder).name))
    assert kernel(_doubles)(2.0) == 4.0
    assert capsys.readouterr().err.count("cannot be kept") == 1


def test_a_user_without_a_home_needs_no_cache_folder(monkeypatch, tmp_path):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(kernel_cache.os.path, "expanduser", lambda path: path)  # as for a user who has none
    assert all(base.is_absolute() for base in kernel_cache._bases())


def test_kernels_that_nobody_used_for_long_are_removed(monkeypatch, tmp_path):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    for name, age_s in (("kernels-old", kernel_cache.UNUSED_S + 60), ("kernels-new", 60), ("other", 1e9)):
        (tmp_path / name / "plugins").mkdir(parents=True)
        os.utime(tmp_path / name, times=(time.time() - age_s,) * 2)
    folder = Path(kernel_cache.cache_folder())
    assert {path.name for path in tmp_path.iterdir()} == {"kernels-new", "other", folder.name}
    os.utime(folder, times=(0, 0))
    kernel_cache.cache_folder()
    assert folder.stat().st_mtime > 0, "its use is noted"


def test_signatures_that_are_saved_at_once_keep_their_own_code(tmp_path):
    def save(i):
        CheckedCacheFile(str(tmp_path), "kernel", "stamp").save(f"signature {i}", f"code {i}")

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(save, range(100)))
    cache = CheckedCacheFile(str(tmp_path), "kernel", "stamp")
    assert [cache.load(f"signature {i}") for i in range(100)] == [f"code {i}" for i in range(100)]


def test_kernels_are_saved_under_the_lock():
    for made in (kernel(lambda x: x + 1), inlined(lambda x: x + 1)):
        assert type(made._cache._cache_file) is CheckedCacheFile
