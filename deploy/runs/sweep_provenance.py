"""Provenance of a sweep's results: the commands, and the commits of this code, that trained them."""

from __future__ import annotations

import dataclasses
import json
import shlex
from pathlib import Path
from typing import Any, NamedTuple

from learner.file_names import SETTINGS
from learner.sweep.grid import SweepConfig

KEY = "sittings"
"""Key of the provenance in `settings.json`."""


class Provenance(NamedTuple):
    """One `shoal sweep` that had cells to run: its command with the grid's options alone, and the code's commit."""

    command: str
    commit: str


def sweep_command(grid: SweepConfig) -> str:
    """The `shoal sweep` command of a grid, with the options that differ from the defaults."""
    words = ["shoal", "sweep"]
    for name, default in dataclasses.asdict(SweepConfig()).items():
        value = getattr(grid, name)
        if value != default:
            words.append(f"--{name.replace('_', '-')}")
            words += [str(each) for each in value] if isinstance(value, tuple) else [str(value)]
    return shlex.join(words)


def read_provenance(table: Path) -> list[Provenance]:
    """The provenance in `settings.json` beside a table of results, oldest first; empty if there is none to read.

    A file of the first format holds the last command alone, as the grid under `sweep` and its `commit`.
    """
    try:
        stored = json.loads((table.parent / SETTINGS).read_text("utf-8-sig"))
        if KEY not in stored:
            return [Provenance(sweep_command(grid_of(stored["sweep"])), str(stored["commit"]))]
        return [Provenance(str(each["command"]), str(each["commit"])) for each in stored[KEY]]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []


def grid_of(values: dict[str, Any]) -> SweepConfig:
    """The grid that `settings.json` stores under `sweep`.

    Raises:
      TypeError: the file is of another version and holds an unknown setting.
      ConfigError: a value is out of range.
    """
    plain: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
    return SweepConfig(**plain)
