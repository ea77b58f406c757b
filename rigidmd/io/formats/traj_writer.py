"""Trajectories of molecules as ASE's own .traj, in double precision: for `ase gui` and `ase.io.read`."""

import contextlib
import os
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from ase.io.trajectory import TrajectoryWriter

from rigidmd.core.files import begin_file, file_fault, whole_file
from rigidmd.core.state import State
from rigidmd.engines.system import System
from rigidmd.errors import OutputError
from rigidmd.io.ase_atoms import atoms_of_sites
from rigidmd.io.formats.traj import ATOMS, MASSLESS, MASSLESS_VELOCITY, Stored, TrajReader
from rigidmd.io.write import writing


class TrajFile:
    """Writes frames to a file as they come; each is handed to the disk at once. See `TrajectoryFile` for the arguments.

    The format keeps a table of frames that moves within the file as it grows. So a run goes on with a copy of the
    frames that a checkpoint knows, which has the bytes of a file that was never left.

    Raises OutputError, here and in every method.
    """

    def __init__(self, path: Path, system: System, velocities: bool, wrapped: bool, kept: Sequence[int] | None = None):
        self._path, self._system = path, system
        self._velocities, self._wrapped = velocities, wrapped
        self._atoms = np.flatnonzero(system.sites.mass > 0)
        self._others = np.flatnonzero(system.sites.mass == 0)
        self._sum, self._frames, self._kept = 0, 0, kept
        self._file: Any = None
        # its symbols, masses and periodicity are those of every frame
        self._like = atoms_of_sites(system, system.site_positions(system.state), None, system.state.cell, 0.0)
        if kept is None:
            self._begin()
        elif kept[1]:
            for _ in self._kept_frames():
                pass

    def _begin(self) -> None:
        with writing(self._path):
            begin_file(self._path)
            self._file = TrajectoryWriter(self._path, "w")

    def cut(self) -> None:
        """Leave out the frames that came after the time of `kept`."""
        if not self._kept or not self._kept[1]:
            self._begin()
            return
        with whole_file(self._path) as temporary, contextlib.closing(TrajectoryWriter(temporary, "w")) as new:
            for frame in self._kept_frames():
                self._append(new, frame)
        with writing(self._path):
            self._file = TrajectoryWriter(self._path, "a")

    @property
    def kept(self) -> tuple[int, int]:
        """Checksum of all frames, which are on the disk, and their number."""
        backend: Any = self._file.backend
        with writing(self._path):
            os.fsync(backend.fd.fileno())
        return self._sum, self._frames

    def write(self, state: State, time: float, step: int) -> None:
        """Add a frame with its own time (ps) and the box."""
        system = self._system
        position = system.site_positions(state, self._wrapped)
        cell = state.cell if np.isfinite(state.cell).all() else None
        found = Stored(position[self._atoms], None, None, None, cell, float(time), int(step))
        if len(self._others):
            found = found._replace(massless=position[self._others])
        if self._velocities:
            velocity = system.site_velocities(state)
            moving = atoms_of_sites(system, position, velocity, state.cell, time)
            found = found._replace(momenta=moving.get_momenta())
            if len(self._others):
                found = found._replace(massless_velocity=velocity[self._others])
        with writing(self._path):
            self._append(self._file, found)
            self._sum, self._frames = self._summed(found), self._frames + 1

    def close(self) -> None:
        """Finish the file."""
        with writing(self._path):
            if self._file is not None:
                self._file.close()

    def _append(self, file: TrajectoryWriter, frame: Stored) -> None:
        atoms = self._like
        atoms.set_positions(frame.positions)
        if frame.cell is not None:
            atoms.set_cell(frame.cell)
        if frame.momenta is not None:
            atoms.set_momenta(frame.momenta)
        atoms.info = {"time_ps": frame.time, "step": frame.step}
        own = {MASSLESS: frame.massless, MASSLESS_VELOCITY: frame.massless_velocity}
        if len(file.backend) == 0:
            own[ATOMS] = self._atoms.astype(np.int64)
        backend: Any = file.backend
        backend.write(**{name: array for name, array in own.items() if array is not None})
        file.write(atoms)

    def _kept_frames(self) -> Iterator[Stored]:
        """The frames that a checkpoint knows, one after the other. Raises OutputError if they have changed."""
        self._sum, (kept_sum, self._frames) = 0, self._kept or (0, 0)
        try:
            if fault := file_fault(self._path):
                raise ValueError(fault)
            with contextlib.closing(TrajReader(self._path)) as old:
                if old.count < self._frames or old.sites != len(self._system.sites.mass):
                    raise ValueError(f"{self._frames} frames of {len(self._system.sites.mass)} sites are needed")
                for k in range(self._frames):
                    frame = old.read(k)
                    self._sum = self._summed(frame)
                    yield frame
        except (ValueError, OSError) as error:
            reason = getattr(error, "strerror", None) or " ".join(str(error).split())
            raise OutputError(f"{self._path} cannot be read to continue it: {reason}") from None
        if self._sum != kept_sum:
            raise OutputError(f"{self._path} has changed or is damaged: its checksum is not that of what was written")

    def _summed(self, frame: Stored) -> int:
        """CRC-32 of the frames so far and this one."""
        found = self._sum
        for part in (*frame[:5], np.array([frame.time, float(frame.step)])):
            if part is not None:
                found = zlib.crc32(np.ascontiguousarray(part, float).tobytes(), found)
        return found
