"""Structured rows in zarr, one array per column, so that any zarr reader can open a saved replay or evaluation.

A missing zarr chunk reads as zeros, so each column's CRC-32 is stored with it and checked on load. Only zarr format 3
is read: format 2 allows the pickle codec, which runs code from the file.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from actors.storage.ring_snapshot import RingSnapshot

FORMAT = "shoal-replay-2"
CHUNK_ROWS = 65_536
"""Rows of a zarr chunk; a multiple of `ring_snapshot.PIECE_ROWS`."""
MAX_ROWS = 100_000_000
"""Most rows that a stored table may declare, since memory is allocated for them before they are read."""


def save_rows(path: Path, rows: NDArray[Any] | RingSnapshot, layout: str = FORMAT) -> None:
    """Writes structured rows `[count]` to a new zarr group at `path`; `layout` is stored as the name of its format."""
    root = zarr.open_group(str(path), mode="w", zarr_format=3)
    count, names = len(rows), rows.dtype.names or ()
    arrays = {name: _new_column(root, name, rows.dtype[name], count) for name in names}
    crc = dict.fromkeys(names, 0)
    for start in range(0, count, CHUNK_ROWS):
        stop = min(count, start + CHUNK_ROWS)
        piece = rows.read(start, stop) if isinstance(rows, RingSnapshot) else rows[start:stop]
        for name, array in arrays.items():
            column = np.ascontiguousarray(piece[name])
            array[start:stop] = column
            crc[name] = zlib.crc32(column.data, crc[name])
    root.attrs.update({"format": layout, "rows": count, "crc32": crc})


def _new_column(root: zarr.Group, name: str, dtype: np.dtype[Any], count: int) -> Any:
    shape = (count, *dtype.shape)
    chunks = (max(1, min(CHUNK_ROWS, count)), *dtype.shape)
    return root.create_array(name, shape=shape, dtype=dtype.base, chunks=chunks, compressors=None, fill_value=0)


def open_store(path: Path) -> zarr.Group:
    """Opens a zarr group for reading.

    Raises:
      ValueError: there is no group, or its zarr format is not 3.
    """
    try:
        return zarr.open_group(str(path), mode="r", zarr_format=3)
    except (FileNotFoundError, NotADirectoryError, zarr.errors.GroupNotFoundError, KeyError) as error:
        raise ValueError(f"{path} is missing or incomplete ({error})") from error


def load_rows(path: Path, dtype: np.dtype[Any], layout: str = FORMAT, at_most: int = MAX_ROWS) -> NDArray[Any]:
    """Reads rows that `save_rows` wrote.

    Args:
      path: the zarr group.
      dtype: structured dtype of the rows.
      layout: name of the format, as given to `save_rows`.
      at_most: most rows to accept.

    Returns:
      `[count]` of `dtype`.

    Raises:
      ValueError: the group is missing or damaged, has other columns, or declares more than `at_most` rows.
    """
    root = open_store(path)
    if root.attrs.get("format") != layout:
        raise ValueError(f"{path} is not in format {layout}")
    try:
        return _read_columns(path, root, dtype, at_most)
    except (KeyError, TypeError, OSError) as error:
        raise ValueError(f"{path} is missing or incomplete ({error})") from error


def _read_columns(path: Path, root: zarr.Group, dtype: np.dtype[Any], at_most: int) -> NDArray[Any]:
    attributes: Any = root.attrs.asdict()
    count = attributes["rows"]
    if not isinstance(count, int) or not 0 <= count <= at_most:
        raise ValueError(f"{path} claims {count!r} rows; at most {at_most} fit")
    names = dtype.names or ()
    arrays: dict[str, Any] = {name: root[name] for name in names}
    for name, array in arrays.items():  # before anything is allocated
        shape = (count, *dtype[name].shape)
        if not isinstance(array, zarr.Array) or array.shape != shape or array.dtype != dtype[name].base:
            what = f"{array.dtype}{array.shape}" if isinstance(array, zarr.Array) else "no array"
            raise ValueError(f"column {name} of {path} is {what}, not {dtype[name].base}{shape}")
    rows = np.zeros(count, dtype)
    for name, array in arrays.items():
        column = np.ascontiguousarray(np.asarray(array[...]))
        if zlib.crc32(column.data) != attributes["crc32"][name]:
            raise ValueError(f"column {name} of {path} is damaged (checksum)")
        rows[name] = column
    return rows
