"""Tables of named tuples as CSV files: in a fixed order, replaced atomically, and checked when they are read."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, get_type_hints

from actors.storage.atomic_write import replacing_file
from sim_core.checks import ConfigError

Row = TypeVar("Row", bound=NamedTuple)


def write_csv(path: Path, kind: type[Row], rows: Iterable[Row]) -> None:
    """Writes rows, sorted, below a line of their fields' names; an older file is replaced by the complete new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing_file(path, sync_first=True) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(kind._fields)
        writer.writerows(sorted(rows))


def read_csv(path: Path, kind: type[Row], content: str, remedy: str) -> list[Row]:
    """Reads what `write_csv` wrote; the row at index i stands in line i + 2.

    Args:
      path: the file.
      kind: the rows' type, whose fields are texts and numbers.
      content: what the rows are, for errors.
      remedy: what the user may do where the file cannot be read.

    Raises:
      ConfigError: the file cannot be read, has other columns, or a value of another type.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:  # as spreadsheets write it
            lines = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"the {content} {path} cannot be read ({error}); {remedy}") from error
    if not lines or tuple(lines[0]) != kind._fields:
        raise ConfigError(f"{path} is no table of {content}: its first line must be {','.join(kind._fields)}")
    types: dict[str, Any] = get_type_hints(kind)
    rows = []
    for number, line in enumerate(lines[1:], start=2):
        try:
            values = [types[name](text) for name, text in zip(kind._fields, line, strict=True)]
        except ValueError as error:
            where = f"{path}, line {number}"
            raise ConfigError(f"{where} is no row of {content} ({error}); make the table again") from error
        rows.append(kind(*values))
    return rows
