"""Files that are written completely or not at all, files that grow by whole pieces, and which files can be read."""

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

#: Bytes that are read at a time.
CHUNK = 1 << 20
#: How an existing file is opened to be continued: no link is followed, where the system can do so.
CONTINUED = os.O_RDWR | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)


def file_fault(path: Path, largest: float = inf) -> str:
    """Why a file cannot be read; empty if it can be. Pipes and devices, which may never end, cannot.

    largest : bytes that it may have
    """
    try:
        found = path.stat()
    except OSError as error:
        return "there is no such file" if error.errno == errno.ENOENT else f"cannot be read: {error.strerror}"
    except ValueError:
        return "there is no such file: its name holds a zero byte"
    if stat.S_ISDIR(found.st_mode):
        return "is a folder"
    if not stat.S_ISREG(found.st_mode):
        return "is no file but a pipe, a socket or a device"
    if found.st_size > largest:
        return f"has {found.st_size / 1e6:.4g} MB; files of up to {largest / 1e6:.4g} MB are read"
    return ""


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary path beside `path`, renamed to it when the block succeeds and removed when it fails.

    A link at `path` is replaced, and what it points to stays.
    """
    temporary = None
    try:
        beside = path.with_name(f".{path.stem}.{secrets.token_hex(8)}{path.suffix}")
        beside.touch(exist_ok=False)  # with the permissions that any new file has
        temporary = beside
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from None
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def is_temporary(path: Path) -> bool:
    """Whether a file is one that a process was writing when it was killed."""
    return re.fullmatch(r"\..+\.[0-9a-f]{16}(\.\w+)?", path.name) is not None


def write_text(path: Path, text: str) -> None:
    """Write a text as a whole file. Raises OutputError."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def begin_file(path: Path) -> None:
    """Make an empty file for a library that opens it by its name; what has the name, a link too, is removed first."""
    path.unlink(missing_ok=True)
    path.touch(exist_ok=False)


def sync_file(path: Path) -> None:
    """Return when what has been written to a file or a folder is on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


class AppendedFile:
    """A file that grows by whole pieces. A piece that cannot be written is taken back. Methods raise OutputError.

    A new file replaces what has its name; an existing one is continued where it was left, once `cut` has been called.
    Neither follows a link.

    kept : `kept` of an earlier time, at which the file is continued; None begins a new file
    patched : offset and first value of bytes that `patch` replaces
    """

    def __init__(self, path: Path, kept: Sequence[int] | None = None, patched: tuple[int, bytes] = (0, b"")):
        self._path = path
        self._size, self._sum = (0, 0) if kept is None else kept
        with self._told("written" if kept is None else "read"):
            if kept is None:
                begin_file(path)
            elif path.is_symlink() or (fault := file_fault(path)):
                raise OutputError(f"{path}: {'is a link' if path.is_symlink() else fault}; the run cannot continue it")
            self._file = os.fdopen(os.open(path, CONTINUED), "r+b", buffering=0)
            if kept is not None:
                try:
                    self._check(*patched)
                except OutputError:
                    self._file.close()
                    raise

    def cut(self) -> None:
        """Cut off what was appended after the time of `kept`."""
        with self._told():
            self._file.truncate(self._size)
            self._file.seek(self._size)

    @property
    def kept(self) -> tuple[int, int]:
        """Bytes so far, all of them on the disk, and the CRC-32 of what was appended."""
        with self._told():
            os.fsync(self._file.fileno())
        return self._size, self._sum

    def append(self, piece: bytes) -> None:
        """Add a piece at the end."""
        with self._told():
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
        with self._told():
            self._file.seek(offset)
            self._write(piece)
            self._file.seek(self._size)

    def close(self) -> None:
        with self._told():
            self._file.close()

    def _check(self, offset: int, first: bytes) -> None:
        """Compare the file with its size and checksum."""
        found, left = 0, self._size
        while left and (piece := bytearray(self._file.read(min(left, CHUNK)))):
            if left == self._size:
                piece[offset : offset + len(first)] = first
            found, left = zlib.crc32(piece, found), left - len(piece)
        if left:
            raise OutputError(f"{self._path} is shorter than it was: {self._size} bytes are needed to continue it")
        if found != self._sum:
            raise OutputError(f"{self._path} has changed or is damaged: its checksum is not that of what was written")

    def _write(self, piece: bytes) -> None:
        rest = memoryview(piece)
        while rest:
            rest = rest[self._file.write(rest) :]

    @contextlib.contextmanager
    def _told(self, done: str = "written") -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OutputError(f"{self._path} cannot be {done}: {error.strerror}") from None
