"""Files that are written completely or not at all, files that grow by whole pieces, and which files can be read."""

import contextlib
import errno
import os
import secrets
import stat
import zlib
from collections.abc import Iterator, Sequence
from math import inf
from pathlib import Path

from rigidmd.errors import OutputError

#: Bytes that are read at a time.
CHUNK = 1 << 20


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
    """A temporary path beside `path`, renamed to it when the block succeeds and removed when it fails."""
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


def sync_file(path: Path) -> None:
    """Return when what has been written to a file or a folder is on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


class AppendedFile:
    """A file that grows by whole pieces. A piece that cannot be written is taken back. Methods raise OutputError.

    kept : `kept` of an earlier time, at which an existing file goes on, its rest cut off; None begins a new file
    patched : offset and first value of bytes that `patch` replaces
    """

    def __init__(self, path: Path, kept: Sequence[int] | None = None, patched: tuple[int, bytes] = (0, b"")):
        self._path = path
        self._size, self._sum = kept or (0, 0)
        with self._told():
            self._file = path.open("wb" if kept is None else "r+b", buffering=0)
            if kept is not None:
                try:
                    self._check(*patched)
                except OutputError:
                    self._file.close()
                    raise
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
        """Close it."""
        with self._told():
            self._file.close()

    def _check(self, offset: int, first: bytes) -> None:
        """Hold the file against its size and checksum."""
        found, left = 0, self._size
        while left and (piece := bytearray(self._file.read(min(left, CHUNK)))):
            if left == self._size:
                piece[offset : offset + len(first)] = first
            found, left = zlib.crc32(piece, found), left - len(piece)
        if left:
            raise OutputError(f"{self._path} is shorter than it was: {self._size} bytes are needed to go on with it")
        if found != self._sum:
            raise OutputError(f"{self._path} has changed or is damaged: its checksum is not that of what was written")

    def _write(self, piece: bytes) -> None:
        rest = memoryview(piece)
        while rest:
            rest = rest[self._file.write(rest) :]

    @contextlib.contextmanager
    def _told(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OutputError(f"{self._path} cannot be written: {error.strerror}") from None
