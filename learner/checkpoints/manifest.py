"""What a checkpoint's manifest says, and how it is refused: pure functions over bytes.

A manifest is two lines: JSON that names the format and every file with its length and SHA-256, and the SHA-256 of
that JSON. So no byte of a checkpoint can change unseen, its manifest included.
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
MOST_BYTES = 64 * 2**20
"""Length that a manifest or a state may have: both are read whole."""


class CheckpointError(ConfigError):
    """A checkpoint that cannot be used; the message says why."""


class UnusableCheckpointError(CheckpointError):
    """None is there, or what is there is damaged or too old: this version can never use it."""


class Manifest(NamedTuple):
    """A manifest's content: env steps at the moment of the checkpoint, and every file by its name."""

    env_steps: int
    files: dict[str, FileSum]


def encode_manifest(env_steps: int, files: dict[str, FileSum]) -> bytes:
    """The manifest of a checkpoint's files."""
    sums = {name: list(found) for name, found in files.items()}
    text = json.dumps({"format": FORMAT, "env_steps": env_steps, "files": sums}, sort_keys=True).encode()
    return text + b"\n" + hashlib.sha256(text).hexdigest().encode() + b"\n"


def decode_manifest(data: bytes, where: object) -> Manifest:
    """Reads a manifest; `where` names its checkpoint in messages.

    Raises:
      UnusableCheckpointError: it is damaged or of an older format.
      CheckpointError: it is of a newer format.
    """
    text, newline, rest = data.partition(b"\n")
    whole = bool(newline) and rest == hashlib.sha256(text).hexdigest().encode() + b"\n"
    _refuse_other_format(text, whole, where)
    if not whole:
        raise damaged(where, MANIFEST)
    values = parse_object(text)
    files = values.get("files") if values is not None else None
    if values is None or not isinstance(files, dict) or STATE not in files or not _is_count(values.get("env_steps")):
        raise damaged(where, f"{MANIFEST} has other content than a manifest")
    for name, found in files.items():
        if not is_safe_name(name) or name == MANIFEST:
            raise damaged(where, f"{MANIFEST} names {name!r}, which is no file of a checkpoint")
        if not _is_sum(found):
            raise damaged(where, f"{MANIFEST} gives {name!r} no length and SHA-256")
    return Manifest(values["env_steps"], {name: FileSum(*found) for name, found in files.items()})


def _refuse_other_format(text: bytes, whole: bool, where: object) -> None:
    """Names another format than ours; up to 3 a manifest had no line with its own checksum."""
    values = parse_object(text) or {}
    found = re.fullmatch(r"shoal-checkpoint-(\d{1,6})", str(values.get("format")))
    if found is None or int(found[1]) == VERSION or not (whole or "sha256" in values):
        return
    message = f"checkpoint {where} is in format {found[0]!r}, this version reads {FORMAT!r}: "
    if int(found[1]) < VERSION:
        raise UnusableCheckpointError(message + "go on with the version of shoal that wrote it, or train anew")
    raise CheckpointError(message + "go on with a newer version of shoal")


def damaged(where: object, what: str) -> UnusableCheckpointError:
    """The error for a checkpoint that is not what was written."""
    return UnusableCheckpointError(f"checkpoint {where} is damaged ({what}); use an older one or train anew")


def parse_object(text: bytes) -> dict[str, Any] | None:
    """The JSON object that a text is; None if it is anything else."""
    try:
        values = json.loads(text)
    except (ValueError, RecursionError):  # no JSON, or one nested without end
        return None
    return values if isinstance(values, dict) else None


def _is_count(value: Any) -> bool:
    return type(value) is int and value >= 0


def _is_sum(found: Any) -> bool:
    if not (isinstance(found, list) and len(found) == 2 and _is_count(found[0])):
        return False
    return isinstance(found[1], str) and re.fullmatch(r"[0-9a-f]{64}", found[1]) is not None
