"""Readers of trajectories for MDAnalysis: of formats that it reads otherwise or not, and with the times of a run."""

from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from MDAnalysis.coordinates.base import ProtoReader, ReaderBase
from MDAnalysis.coordinates.DCD import DCDReader
from MDAnalysis.coordinates.memory import MemoryReader
from MDAnalysis.coordinates.PDB import PDBReader
from MDAnalysis.coordinates.TRJ import NCDFReader
from MDAnalysis.coordinates.TRR import TRRReader
from MDAnalysis.coordinates.XTC import XTCReader
from MDAnalysis.coordinates.XYZ import XYZReader

from rigidmd.io.cells import edges_and_angles
from rigidmd.io.formats.gsd import GsdReader
from rigidmd.io.formats.traj import TrajReader


def dimensions(cell: np.ndarray) -> list[float] | None:
    """A cell (3, 3) in MDAnalysis' form; None without a box."""
    if cell[0, 0] == inf:
        return None
    return edges_and_angles(cell)


class _Sites(ReaderBase):
    """All sites of a file in the order of the scene, molecules whole, where the box begins at the origin."""

    units = {"time": "ps", "length": "Angstrom", "velocity": "Angstrom/ps"}  # noqa: RUF012  (MDAnalysis has it so)
    _file: Any
    n_atoms: int

    def __init__(self, filename, **options):
        super().__init__(filename, **options)
        self._reopen()
        self.ts = self._Timestep(self.n_atoms, **self._ts_kwargs)
        self._read_frame(0)

    @property
    def n_frames(self) -> int:
        return self._file.count

    def _reopen(self):
        self.close()
        self._open(Path(str(self.filename)))
        self._frame = -1

    def _open(self, path: Path) -> None:
        """Set `_file` and `n_atoms`."""
        raise NotImplementedError

    def _take(self, i: int) -> tuple:
        """Positions and velocities (s, 3), cell (3, 3), time (ps) and step of a frame."""
        raise NotImplementedError

    def close(self):
        if hasattr(self, "_file"):
            self._file.close()

    def _read_frame(self, i):
        if not 0 <= i < self.n_frames:
            raise OSError(f"there is no frame {i}")
        positions, velocities, cell, time, step = self._take(i)
        self._frame = self.ts.frame = i
        self.ts.positions = positions
        if velocities is not None:
            self.ts.velocities = velocities
        self.ts.dimensions = None if cell is None else dimensions(cell)
        self.ts.time = time
        self.ts.data["step"] = step
        return self.ts

    def _read_next_timestep(self, ts=None):
        return self._read_frame(self._frame + 1)


class SitesOfGSD(_Sites):
    """A .gsd file. MDAnalysis' own reader returns central particles too, and positions in the box."""

    def _open(self, path: Path) -> None:
        self._file = GsdReader(path)
        self.n_atoms = len(self._file.read(0).sites)

    def _take(self, i: int) -> tuple:
        found = self._file.read(i)
        if len(found.sites) != self.n_atoms:
            raise ValueError(f"frame {i + 1} has another number of sites")
        return found.position[found.sites], found.site_velocities(), found.cell, found.time, found.step


class SitesOfTraj(_Sites):
    """A .traj file of ASE that rigidmd wrote; MDAnalysis has single precision."""

    def _open(self, path: Path) -> None:
        self._file = TrajReader(path)
        self.n_atoms = self._file.sites

    def _take(self, i: int) -> tuple:
        found = self._file.read(i)
        return *self._file.of_sites(found), found.cell, found.time, found.step


class _Timed(ProtoReader):
    """Makes a reader return the times of the run (ps), evenly spaced or not, whatever its file holds."""

    def __init__(self, *source, times: list[float], **options):
        self._times = times
        self._dt = float(times[1] - times[0]) if len(times) > 1 else 0.0
        super().__init__(*source, **options | {"times": times})  # readers give all their options to copies
        self._timed(self.ts)

    @property
    def totaltime(self) -> float:
        """From the first frame to the last, ps."""
        return self._times[-1] - self._times[0]

    def _timed(self, frame):
        frame.time = self._times[frame.frame]
        frame.dt = self._dt
        return frame

    def _read_frame(self, i):
        return self._timed(super()._read_frame(i))

    def _read_next_timestep(self, ts=None):
        # every reader implements it
        return self._timed(super()._read_next_timestep(ts))  # pyright: ignore[reportAbstractUsage]


class TimedFrames(_Timed, MemoryReader): ...


class _TimedXTC(_Timed, XTCReader): ...


class _TimedTRR(_Timed, TRRReader): ...


class _TimedDCD(_Timed, DCDReader): ...


class _TimedNCDF(_Timed, NCDFReader): ...


class _TimedGSD(_Timed, SitesOfGSD): ...


class _TimedTraj(_Timed, SitesOfTraj): ...


class _TimedXYZ(_Timed, XYZReader): ...


class _TimedPDB(_Timed, PDBReader): ...


TIMED = {
    ".xtc": _TimedXTC, ".trr": _TimedTRR, ".gsd": _TimedGSD, ".traj": _TimedTraj, ".dcd": _TimedDCD, ".nc": _TimedNCDF,
    ".xyz": _TimedXYZ, ".pdb": _TimedPDB,
}  # fmt: skip
#: What MDAnalysis calls a format, or the reader itself, where it is not the ending.
FORMATS = {".nc": "NCDF", ".gsd": SitesOfGSD, ".traj": SitesOfTraj}
