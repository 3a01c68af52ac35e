"""Packed rows in zarr, one array a column, so that anybody can read a saved replay or evaluation.

A missing zarr chunk reads as zeros, so the columns' CRCs are stored beside them and checked on load.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

FORMAT = "shoal-replay-1"
CHUNK_ROWS = 65_536


def save_rows(path: Path, rows: NDArray[Any], layout: str = FORMAT) -> None:
    """Writes structured rows `[count]` to a new zarr group at `path`, whose format is named `layout`."""
    root = zarr.open_group(str(path), mode="w")
    crc = {}
    for name in rows.dtype.names or ():
        column = np.ascontiguousarray(rows[name])
        chunks = (max(1, min(CHUNK_ROWS, len(column))), *column.shape[1:])
        array = root.create_array(
            name, shape=column.shape, dtype=column.dtype, chunks=chunks, compressors=None, fill_value=0
        )
        array[...] = column
        crc[name] = zlib.crc32(column.tobytes())
    root.attrs.update({"format": layout, "rows": len(rows), "crc32": crc})


def load_rows(path: Path, dtype: np.dtype[Any], layout: str = FORMAT) -> NDArray[Any]:
    """Reads rows of `dtype` that `save_rows` wrote under the same `layout`.

    Raises:
      ValueError: the group is missing, damaged, or has other columns.
    """
    try:
        root = zarr.open_group(str(path), mode="r")
        if root.attrs.get("format") != layout:
            raise ValueError(f"{path} is not in format {layout}")
        return _read_columns(path, root, dtype)
    except (FileNotFoundError, zarr.errors.GroupNotFoundError, KeyError, OSError) as error:
        raise ValueError(f"{path} is missing or incomplete ({error})") from error


def _read_columns(path: Path, root: zarr.Group, dtype: np.dtype[Any]) -> NDArray[Any]:
    attributes: Any = root.attrs.asdict()
    rows = np.zeros(int(attributes["rows"]), dtype)
    for name in dtype.names or ():
        array = root[name]
        column = np.ascontiguousarray(np.asarray(array[...]))  # type: ignore[index]
        if column.shape != rows[name].shape or column.dtype != rows[name].dtype:
            raise ValueError(
                f"column {name} of {path} is {column.dtype}{column.shape}, not {rows[name].dtype}{rows[name].shape}"
            )
        if zlib.crc32(column.tobytes()) != attributes["crc32"][name]:
            raise ValueError(f"column {name} of {path} is damaged (checksum)")
        rows[name] = column
    return rows
