"""Checkpoints: whole or not there, with a checksum of every file; a reader trusts only what its manifest vouches for.

The nodes write their parts (`actors.storage.fragment_writer`), then the driver adds the state and, last, the manifest.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, NamedTuple

from actors.storage.fragment_writer import FileSum
from actors.storage.uri import Location
from learner.checkpoints.manifest import (
    MANIFEST,
    MOST_BYTES,
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

MAY_CHANGE = ("total_env_steps", *WHERE)
"""Settings that may differ between two sittings of a run."""
KINDS: dict[str, type] = {
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


class Checkpoint(NamedTuple):
    """A verified checkpoint: where its files lie, and the state of `state.json`."""

    folder: Location
    state: dict[str, Any]


class Retention(NamedTuple):
    """Which checkpoints stay: the newest so many, and the best so many by the evaluations during training."""

    newest: int
    best: int
    scores: list[Score]


def commit_checkpoint(
    store: CheckpointStore, draft: Location, env_steps: int, state: dict[str, Any], files: dict[str, FileSum]
) -> Location:
    """Makes a draft with all parts written a checkpoint.

    Args:
      store: the run's checkpoints.
      draft: where the parts are.
      env_steps: env steps so far.
      state: the rest of the state, for JSON.
      files: the parts' files.

    Returns:
      The checkpoint's location.

    Raises:
      OSError: the storage does not take it; older checkpoints stay as they were.
    """
    text = json.dumps(state).encode()
    own = FileSum(len(text), hashlib.sha256(text).hexdigest())
    manifest = encode_manifest(env_steps, {**files, STATE: own})
    return store.location(store.complete(draft, {STATE: text, MANIFEST: manifest}))


def prune_checkpoints(store: CheckpointStore, last: Location, retention: Retention) -> None:
    """Removes all checkpoints but those to keep, and what crashed writers left.

    What calls itself newer than `last`, the one just written, was skipped when the run was resumed: it goes too.
    """
    names = store.names()
    own = names[[store.location(name) for name in names].index(last) :]
    kept = names_to_keep(
        [(name, env_steps_of(name)) for name in own], retention.newest, retention.best, retention.scores
    )
    store.remove([name for name in names if name not in kept])


def read_checkpoint(store: CheckpointStore, name: str) -> Checkpoint:
    """Verifies every file of a checkpoint and reads its state.

    Raises:
      UnusableCheckpointError: it is incomplete, damaged, or of an older format.
      CheckpointError: it is of a newer format.
    """
    location = store.location(name)
    manifest = decode_manifest(_small_file(store, name, MANIFEST), location)
    _verify(store, name, manifest)
    state = parse_object(_small_file(store, name, STATE))
    if state is None:
        raise damaged(location, f"{STATE} is no JSON object")
    return Checkpoint(location, state)


def _open(store: CheckpointStore, name: str, file: str) -> OpenFile:
    try:
        return store.open(name, file)
    except (OSError, ValueError) as error:
        raise damaged(store.location(name), f"{file}: {error}") from error


def _small_file(store: CheckpointStore, name: str, file: str) -> bytes:
    opened, size = _open(store, name, file)
    with opened:
        if size > MOST_BYTES:
            raise damaged(store.location(name), f"{file} has {size} bytes, more than {MOST_BYTES}")
        return opened.read(MOST_BYTES)


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
    """The newest checkpoint that passes, and why newer ones were skipped.

    Raises:
      UnusableCheckpointError: there is none, or all are damaged or too old.
      CheckpointError: the storage does not answer, or none passes and one is of a newer format.
    """
    store, names = _listed(root)
    return _first_valid(root, store, names)


def best_valid(root: Location, scores: list[Score]) -> tuple[Checkpoint, list[str]]:
    """The checkpoint that did best in the evaluations during training and passes, and why better ones were skipped.

    Raises:
      CheckpointError: as for `newest_valid`; or no checkpoint has been evaluated.
    """
    store, names = _listed(root)
    best = best_first([(name, env_steps_of(name)) for name in names], scores)
    if names and not best:
        raise CheckpointError(f"no checkpoint in {root} is as old as an evaluation; use the newest one")
    return _first_valid(root, store, best)


def valid_named(root: Location, name: str) -> Checkpoint:
    """The checkpoint of that name, as `finished_names` lists it.

    Raises:
      UnusableCheckpointError: it is damaged or too old.
      CheckpointError: there is none of that name, it is of a newer format, or the storage does not answer.
    """
    store, names = _listed(root)
    if name not in names:
        there = ", ".join(names) if names else "none"
        raise CheckpointError(f"there is no checkpoint {name!r} in {root}; there are: {there}")
    return read_checkpoint(store, name)


def finished_names(root: Location) -> list[str]:
    """Names of the finished checkpoints, newest first; whether they are whole, a reader finds out.

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
    useless = all(isinstance(error, UnusableCheckpointError) for error in skipped)
    kind = UnusableCheckpointError if useless else CheckpointError
    raise kind(f"no usable checkpoint in {root}{reason}")


def check_state(checkpoint: Checkpoint) -> None:
    """Raises UnusableCheckpointError unless the state has all fields, of the right kinds and no number below 0."""
    for name, kind in KINDS.items():
        value = checkpoint.state.get(name)
        if type(value) is not kind or (isinstance(value, int) and value < 0):
            raise damaged(checkpoint.folder, f"state.json: {name} is no {kind.__name__}, or negative")


def check_config(checkpoint: Checkpoint, config: RunConfig, where: Path) -> None:
    """Raises CheckpointError unless the checkpoint was made with `config`, which stands in the file `where`."""
    try:
        saved = flat_params(from_dict(checkpoint.state["config"]))
    except ConfigError as error:
        raise CheckpointError(f"checkpoint {checkpoint.folder} is of another version of shoal: {error}") from error
    for name, value in flat_params(config).items():
        if name not in MAY_CHANGE and saved[name] != value:
            raise CheckpointError(
                f"checkpoint {checkpoint.folder} was made with another config than {where}, where {name} is {value} "
                f"instead of {saved[name]}; {', '.join(MAY_CHANGE)} alone may change between two sittings"
            )
