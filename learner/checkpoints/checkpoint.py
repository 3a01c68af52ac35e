"""A checkpoint is complete or does not exist, and a reader verifies every byte of it.

1. Each component of the run writes its fragment into a draft and syncs it (`actors.storage.fragment_writer`).
2. The driver commits the draft: it adds `state.json` and then `manifest.json`, which holds the length and SHA-256 of
   every file (`manifest.py`). In a folder, one rename makes the draft a checkpoint. Under a URL, writing the manifest
   does: what has none is no checkpoint (`store.py`).
3. A reader checks the manifest's own checksum, then the length and checksum of every file that it names. It skips a
   damaged checkpoint for the next older one.

`writer.py` runs steps 1 and 2 in the background.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, NamedTuple

from actors.storage.fragment_writer import FileSum
from actors.storage.permissions import may_not_read
from actors.storage.uri import Location
from learner.checkpoints.manifest import (
    MANIFEST,
    MAX_BYTES,
    STATE,
    CheckpointError,
    Manifest,
    UnusableCheckpointError,
    damaged,
    decode_manifest,
    encode_manifest,
    parse_object,
)
from learner.checkpoints.retention import Score, best_first, names_to_keep
from learner.checkpoints.store import CheckpointStore, OpenFile, env_steps_of, open_store
from learner.config import WHERE, RunConfig, flat_params, from_dict
from sim_core.checks import ConfigError

READ_BYTES = 2**20
"""Bytes that are read at once to compute a checksum."""

MAY_CHANGE = ("total_env_steps", *WHERE)
"""Settings that may change when a run is resumed."""
STATE_TYPES: dict[str, type] = {
    "config": dict,
    "env_steps": int,
    "updates": int,
    "incarnation": int,
    "pacing": dict,
    "meters": dict,
    "ledger": dict,
    "due": dict,
    "journal_offset": int,
    "learner": dict,
    "workers": list,
}
"""Fields of `state.json` and their types."""


class Checkpoint(NamedTuple):
    """A verified checkpoint: the location of its files, and the content of `state.json`."""

    folder: Location
    state: dict[str, Any]


class Retention(NamedTuple):
    """Which checkpoints to keep: the `newest` ones, and the `best` ones by `scores` of evaluations during training."""

    newest: int
    best: int
    scores: list[Score]


def commit_checkpoint(
    store: CheckpointStore, draft: Location, env_steps: int, state: dict[str, Any], files: dict[str, FileSum]
) -> Location:
    """Makes a draft that holds all fragments a checkpoint: adds the state and, last, the manifest.

    Args:
      store: the run's checkpoints.
      draft: location of the fragments.
      env_steps: env steps so far.
      state: the driver's state, JSON values.
      files: length and checksum of the fragments' files.

    Returns:
      The checkpoint's location.

    Raises:
      OSError: the storage refuses it; older checkpoints are unchanged.
    """
    text = json.dumps(state).encode()
    state_sum = FileSum(len(text), hashlib.sha256(text).hexdigest())
    manifest = encode_manifest(env_steps, {**files, STATE: state_sum})
    return store.location(store.commit(draft, {STATE: text, MANIFEST: manifest}))


def prune_checkpoints(store: CheckpointStore, last: Location, retention: Retention) -> None:
    """Removes checkpoints that `retention` does not keep, and drafts of crashed writers.

    Checkpoints with more env steps than `last`, the one just written, were skipped as damaged when the run was resumed.
    They are removed, too.
    """
    names = store.names()
    candidates = names[[store.location(name) for name in names].index(last) :]
    kept = names_to_keep([(name, env_steps_of(name)) for name in candidates], *retention)
    store.remove([name for name in names if name not in kept])


def read_checkpoint(store: CheckpointStore, name: str) -> Checkpoint:
    """Verifies every file of a checkpoint and reads its state.

    Raises:
      UnusableCheckpointError: it is incomplete, damaged, or in an older format.
      CheckpointError: it is in a newer format.
    """
    location = store.location(name)
    manifest = decode_manifest(_small_file(store, name, MANIFEST), location)
    _verify(store, name, manifest)
    state = parse_object(_small_file(store, name, STATE))
    if state is None:
        raise damaged(location, f"{STATE} is not a JSON object")
    return Checkpoint(location, state)


def _open(store: CheckpointStore, name: str, file: str) -> OpenFile:
    try:
        return store.open(name, file)
    except PermissionError as error:
        raise CheckpointError(may_not_read(f"checkpoint {store.location(name)}")) from error
    except (OSError, ValueError) as error:
        raise damaged(store.location(name), f"{file}: {error}") from error


def _small_file(store: CheckpointStore, name: str, file: str) -> bytes:
    opened, size = _open(store, name, file)
    with opened:
        if size > MAX_BYTES:
            raise damaged(store.location(name), f"{file} has {size} bytes, more than {MAX_BYTES}")
        return opened.read(MAX_BYTES)


def _verify(store: CheckpointStore, name: str, manifest: Manifest) -> None:
    for file, expected in manifest.files.items():
        opened, size = _open(store, name, file)
        with opened:
            if size != expected.size:
                raise damaged(store.location(name), f"{file}: {size} bytes, not {expected.size}")
            digest = hashlib.sha256()
            try:
                while block := opened.read(READ_BYTES):
                    digest.update(block)
            except OSError as error:
                raise damaged(store.location(name), f"{file}: {error}") from error
        if digest.hexdigest() != expected.sha256:
            raise damaged(store.location(name), f"{file}: its content has another checksum")


def newest_valid(root: Location) -> tuple[Checkpoint, list[str]]:
    """The newest checkpoint that passes verification, and why newer ones were skipped.

    Raises:
      UnusableCheckpointError: there is none, or all are damaged or in an older format.
      CheckpointError: the storage does not answer, or none passes and one is in a newer format.
    """
    store, names = _listed(root)
    return _first_valid(root, store, names)


def best_valid(root: Location, scores: list[Score]) -> tuple[Checkpoint, list[str]]:
    """The checkpoint with the best score that passes verification, and why better ones were skipped.

    Args:
      root: the run's checkpoints.
      scores: the evaluations during training.

    Raises:
      CheckpointError: as for `newest_valid`; or no checkpoint has been evaluated.
    """
    store, names = _listed(root)
    best = best_first([(name, env_steps_of(name)) for name in names], scores)
    if names and not best:
        raise CheckpointError(f"no checkpoint in {root} is from after an evaluation; use the newest one")
    return _first_valid(root, store, best)


def valid_named(root: Location, name: str) -> Checkpoint:
    """The checkpoint `name`, one of `finished_names`, once it has passed verification.

    Raises:
      UnusableCheckpointError: it is damaged or in an older format.
      CheckpointError: there is none of that name, it is in a newer format, or the storage does not answer.
    """
    store, names = _listed(root)
    if name not in names:
        there = ", ".join(names) if names else "none"
        raise CheckpointError(f"there is no checkpoint {name!r} in {root}; there are: {there}")
    return read_checkpoint(store, name)


def finished_names(root: Location) -> list[str]:
    """Names of the committed checkpoints, newest first; they are not verified.

    Raises:
      CheckpointError: the storage does not answer.
    """
    return _listed(root)[1]


def _listed(root: Location) -> tuple[CheckpointStore, list[str]]:
    try:
        store = open_store(root)
        return store, store.names()
    except OSError as error:
        raise CheckpointError(f"the checkpoints at {root} cannot be listed: {error}") from error


def _first_valid(root: Location, store: CheckpointStore, names: list[str]) -> tuple[Checkpoint, list[str]]:
    skipped: list[CheckpointError] = []
    for name in names:
        try:
            return read_checkpoint(store, name), [str(error) for error in skipped]
        except CheckpointError as error:
            skipped.append(error)
    reason = f": {skipped[0]}" if skipped else ""
    all_unusable = all(isinstance(error, UnusableCheckpointError) for error in skipped)
    error_type = UnusableCheckpointError if all_unusable else CheckpointError
    raise error_type(f"no usable checkpoint in {root}{reason}")


def check_state(checkpoint: Checkpoint) -> None:
    """Raises UnusableCheckpointError unless the state has every field of STATE_TYPES, and no negative number there."""
    for name, expected in STATE_TYPES.items():
        value = checkpoint.state.get(name)
        if type(value) is not expected or (isinstance(value, int) and value < 0):
            raise damaged(checkpoint.folder, f"{STATE}: {name} must be of type {expected.__name__} and not negative")


def check_config(checkpoint: Checkpoint, config: RunConfig, config_file: Path) -> None:
    """Raises CheckpointError unless the checkpoint was made with `config`, but for what may change on a resume.

    Args:
      checkpoint: with a state that `check_state` accepts.
      config: the run's config.
      config_file: where the run's folder stores it, for the message.
    """
    try:
        saved = flat_params(from_dict(checkpoint.state["config"]))
    except ConfigError as error:
        raise CheckpointError(f"checkpoint {checkpoint.folder} is from another version of shoal: {error}") from error
    for name, value in flat_params(config).items():
        if name not in MAY_CHANGE and saved[name] != value:
            raise CheckpointError(
                f"checkpoint {checkpoint.folder} was made with another config than {config_file}, where {name} is "
                f"{value} instead of {saved[name]}; only {', '.join(MAY_CHANGE)} may change when a run is resumed"
            )
