"""A file that only grows: what a full disk refuses is held, read as if it were written, and written later, once."""

import errno
import os

import pytest

from actors.storage.append_file import AppendFile
from actors.storage.full_disk import is_disk_full


class SmallDisk:
    """A file on a disk that takes `room` more bytes."""

    def __init__(self, file):
        self._file, self.room = file, 0

    def write(self, data):
        if self.room == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written = self._file.write(data[: self.room])
        self.room -= written
        return written

    def __getattr__(self, name):
        return getattr(self._file, name)


@pytest.fixture
def said():
    return []


@pytest.fixture
def file(tmp_path, said):
    file = AppendFile(tmp_path / "new" / "rows", said.append)
    yield file
    file.close()


def test_a_full_disk_holds_lines_back_and_loses_none(file, said, tmp_path):
    path = tmp_path / "new" / "rows"
    file.append(b"one\n")
    disk = file._file = SmallDisk(file._file)
    disk.room = 2  # a line is cut
    for line in (b"two\n", b"three\n"):
        file.append(line)
    assert path.read_bytes() == b"one\ntw" and file.length == 14
    assert file.read(0) == b"one\ntwo\nthree\n" and file.read(4, 8) == b"two\n" and file.read(8, 11) == b"thr"
    with pytest.raises(OSError, match="No space"):
        file.sync()
    assert len(said) == 1 and "rows cannot grow" in said[0]
    disk.room = 100
    file.append(b"four\n")
    assert path.read_bytes() == file.read(0) == b"one\ntwo\nthree\nfour\n" and file.sync() == 19
    assert len(said) == 2 and "no line is missing" in said[1]


def test_closing_on_a_full_disk_raises_nothing(file):
    file._file = SmallDisk(file._file)
    file.append(b"lost\n")
    file.close()


def test_other_errors_are_raised(file, monkeypatch):
    def refuse(data):
        raise OSError(errno.EIO, "broken")

    disk = file._file = SmallDisk(file._file)
    monkeypatch.setattr(disk, "write", refuse, raising=False)
    with pytest.raises(OSError, match="broken"):
        file.append(b"x")
    file._held = b""


@pytest.mark.parametrize(
    ("error", "is_full"),
    [
        (OSError(errno.ENOSPC, "x"), True),
        (OSError(errno.EFBIG, "x"), True),
        (RuntimeError("OSError: [Errno 27] File too large"), True),
        (OSError(errno.EDQUOT, "x"), True),
        (OSError(errno.EACCES, "x"), False),
        (ValueError("Error while serializing: I/O error: No space left on device (os error 28)"), True),
        (RuntimeError("(sqlite3.OperationalError) database or disk is full"), True),
        (ValueError("the room is full"), False),
    ],
)
def test_a_full_disk_is_known_by_the_errors_of_all_libraries(error, is_full):
    assert is_disk_full(error) == is_full
    try:
        raise RuntimeError("wrapped") from error
    except RuntimeError as wrapped:
        assert is_disk_full(wrapped) == is_full
