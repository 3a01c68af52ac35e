"""Tables that stand beside tables of results, in the same folders, for claims that no results alone decide."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from actors.evaluation.result_table import ResultRow, read_table
from actors.evaluation.value_table import ValueRow, read_values
from learner.file_names import VALUES, VARIANTS


def variants_beside(tables: Sequence[Path]) -> list[ResultRow]:
    """Rows of the tables of variants beside tables of results; empty where there are none.

    Raises:
      ConfigError: a table of variants cannot be read.
    """
    return [row for path in beside(tables, VARIANTS) for row in read_table(path)]


def values_beside(tables: Sequence[Path]) -> list[ValueRow]:
    """Rows of the tables of values beside tables of results; empty where there are none.

    Raises:
      ConfigError: a table of values cannot be read.
    """
    return [row for path in beside(tables, VALUES) for row in read_values(path)]


def beside(tables: Sequence[Path], name: str) -> list[Path]:
    """The files of this name in the tables' folders, each once."""
    paths = dict.fromkeys(table.absolute().parent / name for table in tables)
    return [path for path in paths if path.is_file()]
