"""Methods and scenes by name: those of this package, and a user's own in a Python file.

A user's own is named `FILE.py:CLASS`. The text of the file becomes part of the world's settings (`sources`), so it
goes wherever settings go: to Ray workers, into a run's config, its hash and its checkpoints. A
module made from that text is what runs; the file itself is read once, when the settings are made.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import importlib.util
import json
import os
import re
import sys
import traceback
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from sim_core.checks import ConfigError, require

SOURCES = "SHOAL_SOURCES"
"""Environment variable: a JSON object, file name to text, of files that a submitted job finds on no disk."""
MAX_BYTES = 1_000_000
"""Largest source file that is read."""
NUMBA_PLACE = re.compile(r'File "([^"]+)", line (\d+)')
"""Where numba's own messages say that a kernel cannot be compiled."""


@dataclass(frozen=True, eq=False)
class Kind:
    """What can be named: the setting that names it, its base class, and the classes of this package by name."""

    setting: str
    base: str
    built_in: dict[str, str]


METHODS = Kind(
    "method",
    "sim_core.methods.base:Method",
    {
        "sensor": "sim_core.methods.m_sensor:SensorMethod",
        "in": "sim_core.methods.m_in:InsideMethod",
        "out": "sim_core.methods.m_out:OutsideMethod",
    },
)
"""State representations: M_sensor (Chapter 3), M_IN and M_OUT (Chapter 4)."""
DISSERTATION_METHODS = ("sensor", "in", "out")
"""The three methods of the dissertation, in its order."""
SCENES = Kind("scene", "sim_core.scenes.base:Scene", {"circle": "sim_core.scenes.circle:CircleScene"})
"""Start positions and goals."""


class PluginError(ConfigError):
    """A user's own method or scene that does not do what it must; the message names the file and the line."""


def short_name(kind: Kind, name: str) -> str:
    """What people call it: the name itself, or the class of `FILE.py:CLASS`."""
    return name if name in kind.built_in else name.rpartition(":")[2]


def identity(kind: Kind, name: str) -> str:
    """The name without the file's folder, for hashes: the same file in another folder is the same thing."""
    return name if name in kind.built_in else os.path.basename(name)


def file_of(kind: Kind, name: str) -> str:
    """The absolute path of the file that `name` names; empty where it is one of this package's.

    Raises:
      ConfigError: the name is none of this package's and no `FILE.py:CLASS`.
    """
    if name in kind.built_in:
        return ""
    file, _, cls = name.rpartition(":")
    known = ", ".join(kind.built_in)
    require(
        file.endswith(".py") and cls.isidentifier(),
        f"{kind.setting} must be one of: {known}; or FILE.py:CLASS; not {name!r}",
    )
    require(cls not in kind.built_in, f"{kind.setting} {name!r}: {cls} is taken; give the class another name")
    return os.path.abspath(file)


def read_source(kind: Kind, name: str) -> str:
    """The text of the file that `name` names; empty where it is one of this package's.

    Raises:
      ConfigError: see `file_of`; or the file cannot be read.
    """
    path, file = file_of(kind, name), name.rpartition(":")[0]
    if not path:
        return ""
    shipped = json.loads(os.environ.get(SOURCES, "{}"))
    for key in (os.path.normpath(file), path):
        if key in shipped:
            return str(shipped[key])
    try:
        require(os.path.getsize(path) <= MAX_BYTES, f"{kind.setting} {name!r}: {file} is larger than {MAX_BYTES} bytes")
        return Path(path).read_text("utf-8-sig")
    except (OSError, ValueError) as error:
        raise ConfigError(f"{kind.setting} {name!r}: {file} cannot be read: {error}") from error


def check_unchanged(kind: Kind, name: str, source: str) -> None:
    """Raises ConfigError if the file that `name` names is there and no longer has the text `source`."""
    if name in kind.built_in:
        return
    try:
        text = read_source(kind, name)
    except ConfigError:
        return  # it has gone, and is not needed
    require(
        text == source,
        f"{name.rpartition(':')[0]} has changed since the run began, which holds a copy of it (user_files): put that "
        "copy in its place, or begin another run",
    )


@functools.lru_cache(maxsize=256)
def load(kind: Kind, name: str, source: str) -> type[Any]:
    """The class that `name` names; a user's own is made from `source`.

    Raises:
      ConfigError: there is no such class, or the user's file cannot be run; the message names file and line.
    """
    if name in kind.built_in:
        return _attribute(kind.built_in[name])
    file, _, cls = name.rpartition(":")
    module = _module(kind, os.path.basename(file), source)
    found, base = getattr(module, cls, None), _attribute(kind.base)
    require(
        isinstance(found, type) and issubclass(found, base),
        f"{kind.setting} {name!r}: {os.path.basename(file)} has no class {cls} that derives from {base.__qualname__} "
        f"({base.__module__})",
    )
    assert isinstance(found, type)
    return found


def find(kind: Kind, name: str) -> type[Any]:
    """The class that `name` names now; a user's own file is read (see `read_source` and `load` for errors)."""
    return load(kind, name, read_source(kind, name))


def _attribute(place: str) -> type[Any]:
    module, _, cls = place.partition(":")
    found: type[Any] = getattr(importlib.import_module(module), cls)
    return found


def _module(kind: Kind, file_name: str, source: str) -> ModuleType:
    """The module that `source` makes: from a file of its own, since numba keeps compiled kernels by files."""
    digest = hashlib.sha256(source.encode()).hexdigest()[:16]
    name = f"shoal_{kind.setting}_{digest}"
    if name in sys.modules:
        return sys.modules[name]
    path = _materialised(file_name, source, digest)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise PluginError(f"{kind.setting}: {blame(error, path)}: {reason_of(error)}") from error
    return module


def _materialised(file_name: str, source: str, digest: str) -> Path:
    """A file with the text of a user's own, in a folder that is named by its content.

    Raises:
      ConfigError: it cannot be written.
    """
    from sim_core.kernel_cache import CACHE_FOLDER

    path = Path(CACHE_FOLDER) / "plugins" / digest / file_name
    if _text_of(path) == source:  # a file that is written anew would void the kernels that numba keeps of it
        return path
    draft = path.with_name(f"{file_name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        draft.write_text(source, "utf-8", newline="")
        os.replace(draft, path)
    except OSError as error:
        raise ConfigError(
            f"{file_name} needs a copy in {CACHE_FOLDER}, which cannot be written ({error}); make room there, or name "
            "another folder with NUMBA_CACHE_DIR"
        ) from error
    return path


def _text_of(path: Path) -> str | None:
    """The text of a file; None if it is missing or damaged."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return file.read()
    except (OSError, UnicodeDecodeError):
        return None


def blame(error: BaseException, path: Path) -> str:
    """The place in a user's file that an error comes from, such as `my_method.py, line 12`."""
    if isinstance(error, SyntaxError) and error.lineno:
        return f"{path.name}, line {error.lineno}"
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    named = [line for file, line in NUMBA_PLACE.findall(str(error)) if Path(file).name == path.name]
    if named:
        return f"{path.name}, line {named[-1]}"
    return f"{path.name}, line {frames[-1].lineno}" if frames else path.name


def reason_of(error: BaseException) -> str:
    """What an error says: its type and the first line of its message."""
    try:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    except Exception:  # a user's own exception may not know how to say what it is
        lines = []
    return f"{type(error).__name__}: {lines[0] if lines else ''}".rstrip(": ")


class guarded:  # noqa: N801  # reads as a statement
    """Turns whatever a user's class raises into a PluginError that names its file and line.

    Args:
      cls: the user's class.
      doing: the method of it that runs.
    """

    def __init__(self, cls: type[Any], doing: str) -> None:
        self._cls = cls
        self._doing = doing

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if isinstance(error, Exception) and not isinstance(error, ConfigError):
            place = blame(error, source_file(self._cls))
            raise PluginError(f"{place}: {self._doing} of {self._cls.__name__} raised {reason_of(error)}") from error


def source_file(cls: type[Any]) -> Path:
    """The file that a user's class was made from."""
    return Path(str(getattr(sys.modules[cls.__module__], "__file__", "?")))


def refuse(cls: type[Any], doing: str, what: str) -> PluginError:
    """The error of a method of a user's class that gave what it must not give; it names the line of its `def`."""
    function = getattr(cls, doing, None)
    code, path = getattr(function, "__code__", None), source_file(cls)
    line = f", line {code.co_firstlineno}" if code is not None and code.co_filename == str(path) else ""
    return PluginError(f"{path.name}{line}: {doing} of {cls.__name__} {what}")
