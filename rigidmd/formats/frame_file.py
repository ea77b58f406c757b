"""Base for trajectory files of molecules that a library writes with a frame table inside the file
(GSD, ASE)."""

import contextlib
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Generic, Protocol, TypeVar

import numpy as np

from rigidmd.core.files import LostFileError, atomic_file, create_empty_file, unreadable_reason
from rigidmd.core.state import State
from rigidmd.errors import OutputError
from rigidmd.formats.systems import MolecularSystem


def _identity(path: Path) -> tuple[int, int] | None:
    """Device and number of a file. None without a file."""
    try:
        status = path.lstat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


class Closable(Protocol):
    def close(self) -> object: ...


FileT = TypeVar("FileT", bound=Closable)
FrameT = TypeVar("FrameT")


class FrameFile(Generic[FileT, FrameT]):
    """Writes frames to a file, each to the disk at once. For the arguments see
    `io.trajectory_file.TrajectoryFile`.

    The table of frames moves within a growing file. So a resumed run copies the frames up to the
    checkpoint to a new file, which has the same bytes as the file of a run without interruption.

    Raises OutputError, here and in every method.
    """

    # A format implements these methods.
    _open: Callable[[Path, str], FileT]  # the file of the library, to write "w" or to append "a"
    _frame: Callable[[State, float, int], FrameT]  # the frame of a state, as `_append` takes it
    _append: Callable[[FileT, FrameT], None]  # (file, frame)
    _arrays: Callable[[FrameT], Iterable[np.ndarray]]  # of a frame, for the checksum
    #: The first of the file; raises as `_kept_frames` catches
    _stored_frames: Callable[[int], Iterator[FrameT]]
    _file: FileT  # of the library
    _is_open = False

    def __init__(
        self,
        path: Path,
        system: MolecularSystem,
        velocities: bool,
        wrapped: bool,
        kept: Sequence[int] | None = None,
    ):
        self._path, self._system = path, system
        self._velocities, self._wrapped = velocities, wrapped
        self._sum, self._frames, self._kept = 0, 0, kept
        self._opened: tuple[int, int] | None = None  # device and number of the file that is open
        if kept is None:
            self._open_new()
        elif kept[1]:
            for _ in self._kept_frames():
                pass

    @property
    def kept(self) -> tuple[int, int]:
        """Checksum and number of all frames, which are on the disk. Raises OutputError, see `check`
        too."""
        self.check()
        return self._sum, self._frames

    def check(self) -> None:
        """Raise LostFileError if the file was removed or replaced by another program."""
        if self._is_open and _identity(self._path) != self._opened:
            how = "replaced by another file" if self._path.exists() else "removed"
            raise LostFileError(f"{self._path} was {how} while the run was writing it")

    def write(self, state: State, time: float, step: int) -> None:
        """Add a frame with its own time (ps) and the box."""
        frame = self._frame(state, time, step)
        with self._writing():
            self._append(self._file, frame)
        self._count(frame)

    def cut(self) -> None:
        """Leave out the frames after the checkpoint."""
        if not self._kept or not self._kept[1]:
            self._open_new()
            return
        with self._writing():
            with (
                atomic_file(self._path) as temporary,
                contextlib.closing(self._open(temporary, "w")) as new,
            ):
                for frame in self._kept_frames():
                    self._append(new, frame)
            self._open_file("a")

    def close(self) -> None:
        if self._is_open:
            with self._writing():
                self._file.close()

    def _open_new(self) -> None:
        with self._writing():
            create_empty_file(self._path)
            self._open_file("w")

    def _open_file(self, mode: str) -> None:
        self._file, self._is_open = self._open(self._path, mode), True
        self._opened = _identity(self._path)

    def _kept_frames(self) -> Iterator[FrameT]:
        """The frames up to the checkpoint. Raises OutputError if they have changed."""
        kept_sum, count = self._kept or (0, 0)
        self._sum = self._frames = 0
        try:
            if reason := unreadable_reason(self._path):
                raise ValueError(reason)
            for frame in self._stored_frames(count):
                yield frame
                self._count(frame)
        except (ValueError, RuntimeError, KeyError, OSError) as error:
            raise OutputError(
                f"{self._path} cannot be read to continue it: {_reason(error)}"
            ) from None
        if self._sum != kept_sum:
            raise OutputError(
                f"{self._path} has changed or is damaged: its checksum is not that of what was"
                " written"
            )

    def _count(self, frame: FrameT) -> None:
        self._frames += 1
        for array in self._arrays(frame):
            self._sum = zlib.crc32(np.ascontiguousarray(array).tobytes(), self._sum)

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except (OSError, RuntimeError) as error:
            raise OutputError(f"{self._path} cannot be written: {_reason(error)}") from None


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or " ".join(str(error).split())
