"""Checks of a checkpoint's state before anything is done with it: it must be of this kind, and of this config."""

from __future__ import annotations

from pathlib import Path

from learner.checkpoint import Checkpoint
from learner.config import WHERE, RunConfig, flat_params, from_dict
from learner.manifest import CheckpointError, damaged
from sim_core.checks import ConfigError

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


def check_state(checkpoint: Checkpoint) -> None:
    """Raises UselessCheckpointError unless the state has all fields, of the right kinds and no number below 0."""
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
