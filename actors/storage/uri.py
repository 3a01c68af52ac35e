"""Where checkpoint files are: a local path, or an fsspec URL, whose files go through a temporary folder.

Object storage has neither rename nor fsync. What makes a checkpoint complete there is the file that is written last.
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
"""A local path, or a URL as a string."""


def parse_location(text: str) -> Location:
    """Parses a location that a user gives; `file://` URLs and plain paths are local.

    Raises:
      ConfigError: the URL contains a user or password.
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


def join_location(location: Location, name: str) -> Location:
    """Location of the file or folder `name` inside `location`."""
    return location / name if isinstance(location, Path) else f"{location}/{name}"


def is_safe_name(name: str) -> bool:
    """Whether a relative name with `/` as separator stays inside any folder that it is joined to."""
    parts = PurePosixPath(name).parts
    plain = "/".join(parts) == name and bool(parts) and ".." not in parts and not name.startswith("/")
    return plain and "\\" not in name and "\0" not in name


@contextmanager
def storage_errors(location: Location) -> Iterator[None]:
    """Converts the errors of storage clients, each of which has its own types, to OSError with the location."""
    try:
        yield
    except (OSError, ConfigError):
        raise
    except Exception as error:
        raise OSError(f"{location}: {type(error).__name__} {first_line(error)}") from error


def filesystem(url: str) -> tuple[Any, str]:
    """Opens the fsspec file system of a URL, without a cache of listings.

    Returns:
      (file system, path of the URL in it).

    Raises:
      ConfigError: no installed package handles the URL's protocol.
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
    """Writes a small file to a URL and removes it again.

    Raises:
      ConfigError: this failed.
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
    """Yields a local path to write a file or folder to; after the `with` block its content is at `location`."""
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
    """Yields a local path from which to read the file or folder at `location`, valid within the `with` block.

    Raises:
      OSError: nothing is there, or a name there would escape the folder.
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
            if not all(is_safe_name(name) for name in names):
                raise OSError(f"{location} contains names that lead out of its folder")
            local = [Path(folder) / name for name in names]
            for target in local:
                target.parent.mkdir(parents=True, exist_ok=True)
            files.get(found, [str(target) for target in local])
        yield Path(folder) / location.rsplit("/", 1)[1]


def files_under(path: Path) -> dict[str, Path]:
    """All files of a file or folder, by their names relative to the parent folder of `path`."""
    found = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    return {file.relative_to(path.parent).as_posix(): file for file in sorted(found)}
