"""Files that are written atomically, files that grow by whole records, and which files can be
read."""

import contextlib
import errno
import os
import re
import secrets
import stat
import zlib
from collections.abc import Iterator, Sequence
from math import inf
from pathlib import Path

from rigidmd.errors import OutputError

CHUNK = 1 << 20  # bytes read at a time
#: Flags to open an existing file for appending. Links are not followed.
APPEND_FLAGS = os.O_RDWR | os.O_NOFOLLOW


def unreadable_reason(path: Path, largest: float = inf) -> str:
    """Why a file cannot be read, or an empty text if it can be read. Pipes and devices are
    rejected, because they may never end.

    largest : greatest size in bytes
    """
    try:
        status = path.stat()
    except OSError as error:
        if error.errno == errno.ENOENT:
            return "there is no such file"
        return f"cannot be read: {error.strerror}"
    except ValueError:
        return "there is no such file: its name contains a zero byte"
    if stat.S_ISDIR(status.st_mode):
        return "is a folder"
    if not stat.S_ISREG(status.st_mode):
        return "is a pipe, a socket or a device, not a file"
    if status.st_size > largest:
        return f"has {status.st_size / 1e6:.4g} MB. Files of up to {largest / 1e6:.4g} MB are read"
    return ""


def untrusted_reason(found: os.stat_result) -> str:
    """Why a file or folder may have been written by others than this user and root. Empty if it
    cannot.

    found : of `os.lstat` or `os.fstat`
    """
    if stat.S_ISLNK(found.st_mode):
        return "is a link"
    if found.st_uid not in (os.geteuid(), 0):
        return "belongs to another user"
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return "may be written by others (chmod go-w forbids that)"
    return ""


class LostFileError(OutputError):
    """A file of a run was removed, replaced or changed by another program while the run was writing
    it."""


@contextlib.contextmanager
def writing(path: Path, what: str = "written", hint: str = "") -> Iterator[None]:
    """Within it an OSError becomes an OutputError: PATH cannot be `what`, the reason, and a
    hint."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"{path} cannot be {what}: {error.strerror or error}{hint}") from None


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """A temporary path in the folder of `path`, renamed to `path` when the block succeeds and
    removed when it fails. A link at `path` is replaced. Its target is not changed."""
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(8)}{path.suffix}")
    with writing(path):
        temporary.touch(exist_ok=False)  # with the permissions of any new file
        try:
            yield temporary
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def is_temporary(path: Path) -> bool:
    """Whether a file is a temporary file of `atomic_file`, left by a process that was killed."""
    return re.fullmatch(r"\..+\.[0-9a-f]{16}(\.\w+)?", path.name) is not None


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically. Raises OutputError."""
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def create_empty_file(path: Path) -> None:
    """Create an empty file for a library that opens it by name. An existing file or link is removed
    first."""
    path.unlink(missing_ok=True)
    path.touch(exist_ok=False)


def sync_file(path: Path) -> None:
    """Flush a file or a folder to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


class AppendedFile:
    """A file that grows by whole records. A record that cannot be written is removed. Methods raise
    OutputError.

    A new file replaces an existing one. An existing file is continued after `cut` has been called.
    Links are not followed.

    kept : an earlier value of the property `kept`, at which the file is continued. None starts a
        new file
    patched : offset and original value of bytes that `patch` replaces
    """

    def __init__(
        self, path: Path, kept: Sequence[int] | None = None, patched: tuple[int, bytes] = (0, b"")
    ):
        self._path = path
        self._size, self._sum = (0, 0) if kept is None else kept
        self._is_whole = True  # whether each record was appended to all records before it
        with writing(path, "written" if kept is None else "read"):
            if kept is None:
                create_empty_file(path)
            elif path.is_symlink() or (reason := unreadable_reason(path)):
                raise OutputError(
                    f"{path}: {'is a link' if path.is_symlink() else reason}. The run cannot"
                    " continue it"
                )
            self._file = os.fdopen(os.open(path, APPEND_FLAGS), "r+b", buffering=0)
            if why := "" if kept is None else self._difference(*patched):
                self._file.close()
                raise OutputError(f"{path} {why}")

    def cut(self) -> None:
        """Remove everything that was appended after the time of `kept`."""
        with writing(self._path):
            self._file.truncate(self._size)
            self._file.seek(self._size)

    @property
    def kept(self) -> tuple[int, int]:
        """Size in bytes, after flushing to the disk, and the CRC-32 of the appended records. Raises
        OutputError, see `check` too."""
        with writing(self._path):
            os.fsync(self._file.fileno())
        self.check()
        return self._size, self._sum

    def check(self) -> None:
        """Raise LostFileError if the file that is being written was removed, replaced or changed by
        another program."""
        ours = os.fstat(self._file.fileno())
        try:
            status = self._path.lstat()
        except OSError:
            raise LostFileError(f"{self._path} was removed while the run was writing it") from None
        if (status.st_dev, status.st_ino) != (ours.st_dev, ours.st_ino):
            raise LostFileError(
                f"{self._path} was replaced by another file while the run was writing it"
            )
        if not self._is_whole or ours.st_size != self._size:
            raise LostFileError(
                f"{self._path} was changed by another program while the run was writing it"
            )

    def append(self, piece: bytes) -> None:
        """Append a record. A file that another program has cut is known to `check`."""
        with writing(self._path):
            self._is_whole &= os.fstat(self._file.fileno()).st_size == self._size
            try:
                self._write(piece)
            except OSError:
                with contextlib.suppress(OSError):
                    self._file.truncate(self._size)
                raise
            self._size += len(piece)
            self._sum = zlib.crc32(piece, self._sum)

    def patch(self, offset: int, piece: bytes) -> None:
        """Replace bytes at an offset."""
        with writing(self._path):
            self._file.seek(offset)
            self._write(piece)
            self._file.seek(self._size)

    def close(self) -> None:
        with writing(self._path):
            self._file.close()

    def _difference(self, offset: int, first: bytes) -> str:
        """How the file differs from its size and checksum. Empty if it does not."""
        checksum = 0
        left = self._size
        while left and (piece := bytearray(self._file.read(min(left, CHUNK)))):
            if left == self._size:
                piece[offset : offset + len(first)] = first
            checksum = zlib.crc32(piece, checksum)
            left = left - len(piece)
        if left:
            return f"is shorter than it was: {self._size} bytes are needed to continue it"
        return (
            "" if checksum == self._sum else "has changed or is damaged: its checksum has changed"
        )

    def _write(self, piece: bytes) -> None:
        unwritten = memoryview(piece)
        while unwritten:
            unwritten = unwritten[self._file.write(unwritten) :]
