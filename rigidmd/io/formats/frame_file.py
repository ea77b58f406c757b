"""Base of the trajectory files that are written by a library with a table of frames inside the file (GSD, ASE)."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rigidmd.core.files import unreadable_reason
from rigidmd.engines.system import System
from rigidmd.errors import OutputError
from rigidmd.io.write import writing


class FrameFile(ABC):
    """Writes frames to a file, each to the disk at once. See `TrajectoryFile` for the arguments.

    The table of frames moves within a growing file. So a resumed run copies the frames up to the checkpoint to a new
    file, which has the same bytes as the file of a run without interruption.

    Raises OutputError, here and in every method.
    """

    def __init__(self, path: Path, system: System, velocities: bool, wrapped: bool, kept: Sequence[int] | None = None):
        self._path, self._system = path, system
        self._velocities, self._wrapped = velocities, wrapped
        self._sum, self._frames, self._kept = 0, 0, kept
        self._file: Any = None

    @property
    def kept(self) -> tuple[int, int]:
        """Checksum and number of all frames, which are on the disk."""
        return self._sum, self._frames

    def close(self) -> None:
        if self._file is not None:
            with writing(self._path):
                self._file.close()

    def _kept_frames(self) -> Iterator[Any]:
        """The frames up to the checkpoint. Raises OutputError if they have changed."""
        self._sum, (kept_sum, self._frames) = 0, self._kept or (0, 0)
        try:
            if reason := unreadable_reason(self._path):
                raise ValueError(reason)
            for frame in self._stored_frames(self._frames):
                self._sum = self._summed(frame)
                yield frame
        except (ValueError, RuntimeError, KeyError, OSError) as error:
            raise OutputError(f"{self._path} cannot be read to continue it: {reason_of(error)}") from None
        if self._sum != kept_sum:
            raise OutputError(f"{self._path} has changed or is damaged: its checksum is not that of what was written")

    @abstractmethod
    def _stored_frames(self, count: int) -> Iterator[Any]:
        """The first frames of the file. Raises ValueError, RuntimeError, KeyError or OSError."""

    @abstractmethod
    def _summed(self, frame: Any) -> int:
        """CRC-32 of the frames so far and this one."""


def reason_of(error: Exception) -> str:
    return getattr(error, "strerror", None) or " ".join(str(error).split())
