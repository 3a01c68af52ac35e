"""Arrays of a checkpoint that TensorFlow wrote, without TensorFlow.

A checkpoint `PREFIX` of one shard is a file `PREFIX.data-00000-of-00001` of raw arrays, and a table `PREFIX.index` in
LevelDB's format that says where each lies (`tensorflow/core/protobuf/tensor_bundle.proto`).
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

MAGIC = 0xDB4775248B80FB57
"""Last eight bytes of a table."""
FOOTER_BYTES = 48
FLOAT32 = 1
"""Number of float32 in TensorFlow's `DataType`."""
VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
"""Wire types of a protocol buffer."""


def read_arrays(prefix: Path) -> dict[str, NDArray[np.float32]]:
    """The float32 arrays of a checkpoint, by name.

    Args:
      prefix: the path of its files without their endings.

    Raises:
      ValueError: the table is none, is compressed or is of several shards.
    """
    data = prefix.with_name(f"{prefix.name}.data-00000-of-00001").read_bytes()
    found = {}
    for key, value in _table(prefix.with_name(f"{prefix.name}.index").read_bytes()):
        entry = _message(value)
        if not key:
            if entry.get(1, [0]) != [1]:
                raise ValueError(f"{prefix}: not one shard")
        elif entry.get(1) == [FLOAT32]:
            shape = [_message(size).get(1, [0])[0] for size in _message(entry[2][0]).get(2, [])]
            offset, size = entry.get(4, [0])[0], entry[5][0]
            found[key.decode()] = np.frombuffer(data[offset : offset + size], "<f4").reshape(shape)
    return found


def _table(table: bytes) -> Iterator[tuple[bytes, bytes]]:
    """(key, value) of a table, block after block."""
    footer = table[-FOOTER_BYTES:]
    if int.from_bytes(footer[-8:], "little") != MAGIC:
        raise ValueError("no table of a checkpoint")
    at = _handle(footer, 0)[2]  # behind the handle of the meta index
    offset, size, _ = _handle(footer, at)
    for _, handle in _block(table, offset, size):
        begin, length, _ = _handle(handle, 0)
        yield from _block(table, begin, length)


def _block(table: bytes, offset: int, size: int) -> Iterator[tuple[bytes, bytes]]:
    """(key, value) of a block, whose keys leave out what they share with the key before."""
    if table[offset + size]:
        raise ValueError("a block of the table is compressed")
    block = table[offset : offset + size]
    end = size - 4 * (1 + int.from_bytes(block[-4:], "little"))  # where the restart points begin
    at, key = 0, b""
    while at < end:
        shared, at = _varint(block, at)
        own, at = _varint(block, at)
        length, at = _varint(block, at)
        key = key[:shared] + block[at : at + own]
        yield key, block[at + own : at + own + length]
        at += own + length


def _handle(data: bytes, at: int) -> tuple[int, int, int]:
    """Offset and size of a block, and where the handle ends."""
    offset, at = _varint(data, at)
    size, at = _varint(data, at)
    return offset, size, at


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A number of seven bits a byte, the lowest first, and where it ends."""
    value = shift = 0
    while True:
        value |= (data[at] & 0x7F) << shift
        shift, at = shift + 7, at + 1
        if data[at - 1] < 0x80:
            return value, at


def _message(data: bytes) -> dict[int, list]:
    """Values of a protocol buffer by number of their field: integers, or bytes."""
    found: dict[int, list] = {}
    at = 0
    while at < len(data):
        tag, at = _varint(data, at)
        kind, value = tag & 7, None
        if kind == VARINT:
            value, at = _varint(data, at)
        elif kind == BYTES:
            length, at = _varint(data, at)
            value, at = data[at : at + length], at + length
        elif kind in (FIXED32, FIXED64):
            width = 4 if kind == FIXED32 else 8
            value, at = int.from_bytes(data[at : at + width], "little"), at + width
        else:
            raise ValueError(f"a protocol buffer with wire type {kind}")
        found.setdefault(tag >> 3, []).append(value)
    return found
