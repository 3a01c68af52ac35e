"""The manifest of a checkpoint: encoding, decoding, and the errors that refuse one. Pure functions over bytes.

A manifest has two lines. The first is JSON: the format, the env steps, and the length and SHA-256 of every file. The
second is the SHA-256 of the first. No byte of a checkpoint can change undetected, those of its manifest included.
"""

from __future__ import annotations

import hashlib
import json
import re
from typing import Any, NamedTuple

from actors.storage.fragment_writer import FileSum
from actors.storage.uri import is_safe_name
from sim_core.checks import ConfigError

VERSION = 5
FORMAT = f"shoal-checkpoint-{VERSION}"
MANIFEST = "manifest.json"
STATE = "state.json"
MAX_BYTES = 64 * 2**20
"""Largest manifest or state that is read: both are read into memory whole."""


class CheckpointError(ConfigError):
    """A checkpoint cannot be used; the message says why."""


class UnusableCheckpointError(CheckpointError):
    """There is no checkpoint, or it is damaged or in an older format: this version will never be able to use it."""


class Manifest(NamedTuple):
    """Content of a manifest: the run's env steps at the checkpoint, and length and checksum of every file by name."""

    env_steps: int
    files: dict[str, FileSum]


def encode_manifest(env_steps: int, files: dict[str, FileSum]) -> bytes:
    """The manifest of a checkpoint with these files."""
    sums = {name: list(file_sum) for name, file_sum in files.items()}
    text = json.dumps({"format": FORMAT, "env_steps": env_steps, "files": sums}, sort_keys=True).encode()
    return text + b"\n" + hashlib.sha256(text).hexdigest().encode() + b"\n"


def decode_manifest(data: bytes, where: object) -> Manifest:
    """Decodes and checks a manifest.

    Args:
      data: content of the manifest's file.
      where: the checkpoint's location, for messages.

    Raises:
      UnusableCheckpointError: it is damaged or in an older format.
      CheckpointError: it is in a newer format.
    """
    text, newline, rest = data.partition(b"\n")
    is_intact = bool(newline) and rest == hashlib.sha256(text).hexdigest().encode() + b"\n"
    _refuse_other_format(text, is_intact, where)
    if not is_intact:
        raise damaged(where, MANIFEST)
    values = parse_object(text)
    files = values.get("files") if values is not None else None
    if values is None or not isinstance(files, dict) or STATE not in files or not _is_count(values.get("env_steps")):
        raise damaged(where, f"{MANIFEST} does not hold a manifest")
    for name, file_sum in files.items():
        if not is_safe_name(name) or name == MANIFEST:
            raise damaged(where, f"{MANIFEST} names {name!r}, which cannot be a file of a checkpoint")
        if not _is_sum(file_sum):
            raise damaged(where, f"{MANIFEST} has no length and SHA-256 for {name!r}")
    return Manifest(values["env_steps"], {name: FileSum(*file_sum) for name, file_sum in files.items()})


def _refuse_other_format(text: bytes, is_intact: bool, where: object) -> None:
    """Refuses a manifest in another format by its name. Formats 1 to 3 had no second line, but a key `sha256`."""
    values = parse_object(text) or {}
    match = re.fullmatch(r"shoal-checkpoint-(\d{1,6})", str(values.get("format")))
    if match is None or int(match[1]) == VERSION or not (is_intact or "sha256" in values):
        return
    message = f"checkpoint {where} is in format {match[0]!r}, this version reads {FORMAT!r}: "
    if int(match[1]) < VERSION:
        raise UnusableCheckpointError(message + "resume with the version of shoal that wrote it, or start a new run")
    raise CheckpointError(message + "resume with a newer version of shoal")


def damaged(where: object, what: str) -> UnusableCheckpointError:
    """The error for a checkpoint whose content is not what was written."""
    return UnusableCheckpointError(f"checkpoint {where} is damaged ({what}); use an older one or start a new run")


def parse_object(text: bytes) -> dict[str, Any] | None:
    """The JSON object in `text`; None if `text` is anything else."""
    try:
        values = json.loads(text)
    except (ValueError, RecursionError):  # not JSON, or nested too deeply
        return None
    return values if isinstance(values, dict) else None


def _is_count(value: Any) -> bool:
    return type(value) is int and value >= 0


def _is_sum(value: Any) -> bool:
    if not (isinstance(value, list) and len(value) == 2 and _is_count(value[0])):
        return False
    return isinstance(value[1], str) and re.fullmatch(r"[0-9a-f]{64}", value[1]) is not None
