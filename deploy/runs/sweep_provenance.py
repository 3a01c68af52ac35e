"""The sittings of a sweep: with which commands, and with which commit of this code, its results came about."""

from __future__ import annotations

import dataclasses
import json
import shlex
from pathlib import Path
from typing import Any, NamedTuple

from learner.file_names import SETTINGS
from learner.sweep.grid import SweepConfig


class Sitting(NamedTuple):
    """One start of a sweep that had cells to run: its command without where and how many at once, and the commit."""

    command: str
    commit: str


def sweep_command(grid: SweepConfig) -> str:
    """The command line whose grid this is, with what differs from the defaults."""
    words = ["shoal", "sweep"]
    for name, default in dataclasses.asdict(SweepConfig()).items():
        value = getattr(grid, name)
        if value != default:
            words.append(f"--{name.replace('_', '-')}")
            words += [str(each) for each in value] if isinstance(value, tuple) else [str(value)]
    return shlex.join(words)


def read_sittings(table: Path) -> list[Sitting]:
    """Those that `settings.json` beside a table of results names; none without such a file.

    Before there were sittings, the file told of the last one alone, as `sweep` and `commit`.
    """
    try:
        stored = json.loads((table.parent / SETTINGS).read_text())
        if "sittings" not in stored:
            return [Sitting(sweep_command(grid_of(stored["sweep"])), str(stored["commit"]))]
        return [Sitting(str(each["command"]), str(each["commit"])) for each in stored["sittings"]]
    except (OSError, ValueError, KeyError, TypeError):
        return []


def grid_of(values: dict[str, Any]) -> SweepConfig:
    """The grid that `settings.json` stores as `sweep`.

    Raises:
      TypeError: a later version has no such setting.
      ConfigError: a value is out of range.
    """
    plain: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
    return SweepConfig(**plain)
