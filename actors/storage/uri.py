"""Where a checkpoint's files lie: a local path, or an fsspec URL, whose files pass through a temporary folder.

A URL's storage has no rename and no fsync; what counts there is which file is written last.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from fsspec.core import url_to_fs

from actors.service.fault_policy import first_line
from sim_core.checks import ConfigError

Location = Path | str
"""A local path, or a URL as text."""


def as_location(text: str) -> Location:
    """The location that a user names; `file://` and plain paths are local.

    Raises:
      ConfigError: the URL holds a password.
    """
    if "://" not in text:
        return Path(text).absolute()
    if text.startswith("file://"):
        return Path(text.removeprefix("file://")).absolute()
    if "@" in text.split("://", 1)[1].split("/", 1)[0]:
        raise ConfigError(
            "a checkpoint URL must not hold a user or password; put them into the storage's own environment "
            "variables or files, such as AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
        )
    return text.rstrip("/")


def inside(location: Location, name: str) -> Location:
    """The file or folder `name` of a location."""
    return location / name if isinstance(location, Path) else f"{location}/{name}"


def is_plain(name: str) -> bool:
    """Whether a relative name, with `/` between its parts, stays inside whatever it is joined to."""
    parts = PurePosixPath(name).parts
    plain = "/".join(parts) == name and bool(parts) and ".." not in parts and not name.startswith("/")
    return plain and "\\" not in name and "\0" not in name


@contextmanager
def storage_errors(location: Location) -> Iterator[None]:
    """Turns what a storage's client raises (each its own) into OSError that names the location."""
    try:
        yield
    except (OSError, ConfigError):
        raise
    except Exception as error:
        raise OSError(f"{location}: {type(error).__name__} {first_line(error)}") from error


def filesystem(url: str) -> tuple[Any, str]:
    """The fsspec file system of a URL, which remembers no listings, and the URL's path in it.

    Raises:
      ConfigError: nothing here speaks the URL's protocol.
    """
    try:
        found: tuple[Any, str] = url_to_fs(url, use_listings_cache=False)
    except (ImportError, ValueError) as error:
        raise ConfigError(
            f"{url} cannot be opened ({error}); s3:// needs `pip install 'shoal[s3]'`, other protocols their fsspec "
            "package, and file, s3, memory are tested"
        ) from error
    return found


def check_writable(url: str) -> None:
    """Writes a small file to a URL and removes it.

    Raises:
      ConfigError: that is not possible.
    """
    try:
        with storage_errors(url):
            files, path = filesystem(url)
            files.pipe_file(f"{path}/.shoal-was-here", b"shoal")
            files.rm_file(f"{path}/.shoal-was-here")
    except OSError as error:
        raise ConfigError(f"{url} cannot be written to ({error}); name a folder or bucket that you may write to") from (
            error
        )


@contextmanager
def staged(location: Location) -> Iterator[Path]:
    """A local path to write a file or folder to, which is at `location` once the `with` block has ended."""
    if isinstance(location, Path):
        location.parent.mkdir(parents=True, exist_ok=True)
        yield location
        return
    with tempfile.TemporaryDirectory(prefix="shoal-") as folder:
        local = Path(folder) / location.rsplit("/", 1)[1]
        yield local
        with storage_errors(location):
            files, path = filesystem(location)
            made = files_under(local)
            target = path.rsplit("/", 1)[0]
            files.put([str(file) for file in made.values()], [f"{target}/{name}" for name in made])


@contextmanager
def fetched(location: Location) -> Iterator[Path]:
    """A local path to read the file or folder at `location` from, within the `with` block.

    Raises:
      OSError: nothing is there, or a name there would lead elsewhere.
    """
    if isinstance(location, Path):
        yield location
        return
    with tempfile.TemporaryDirectory(prefix="shoal-") as folder:
        with storage_errors(location):
            files, path = filesystem(location)
            found = files.find(path)
            if not found:
                raise FileNotFoundError(f"there is nothing at {location}")
            parent = path.rsplit("/", 1)[0] + "/"
            names = [file.removeprefix(parent) for file in found]
            if not all(is_plain(name) for name in names):
                raise OSError(f"{location} holds names that lead out of its folder")
            local = [Path(folder) / name for name in names]
            for target in local:
                target.parent.mkdir(parents=True, exist_ok=True)
            files.get(found, [str(target) for target in local])
        yield Path(folder) / location.rsplit("/", 1)[1]


def files_under(path: Path) -> dict[str, Path]:
    """Every file of a file or folder, by its name relative to the folder around `path`."""
    found = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    return {file.relative_to(path.parent).as_posix(): file for file in sorted(found)}
