"""Readers of trajectories for MDAnalysis: of GSD and ASE files as sites, and of all formats with the times of a run."""

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

from rigidmd.core.state import edges_and_angles
from rigidmd.io.formats.gsd import GsdReader
from rigidmd.io.formats.traj import TrajReader


def dimensions(cell: np.ndarray) -> list[float] | None:
    """A cell (3, 3) in MDAnalysis' form; None without a box."""
    if cell[0, 0] == inf:
        return None
    return edges_and_angles(cell)


class _SiteReader(ReaderBase):
    """Base of readers of all sites in the order of the scene. Molecules are whole and the box begins at the origin."""

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

    def _read_sites(self, i: int) -> tuple:
        """Positions and velocities (s, 3), cell (3, 3), time (ps) and step of a frame."""
        raise NotImplementedError

    def close(self):
        if hasattr(self, "_file"):
            self._file.close()

    def _read_frame(self, i):
        if not 0 <= i < self.n_frames:
            raise OSError(f"frame {i} does not exist")
        positions, velocities, cell, time, step = self._read_sites(i)
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


class GsdSiteReader(_SiteReader):
    """A .gsd file. MDAnalysis' reader returns central particles too, and wrapped positions."""

    def _open(self, path: Path) -> None:
        self._file = GsdReader(path)
        self.n_atoms = len(self._file.read(0).sites)

    def _read_sites(self, i: int) -> tuple:
        found = self._file.read(i)
        if len(found.sites) != self.n_atoms:
            raise ValueError(f"frame {i + 1} has another number of sites")
        return found.position[found.sites], found.site_velocities(), found.cell, found.time, found.step


class TrajSiteReader(_SiteReader):
    """A .traj file of ASE that rigidmd wrote. MDAnalysis has single precision."""

    def _open(self, path: Path) -> None:
        self._file = TrajReader(path)
        self.n_atoms = self._file.sites

    def _read_sites(self, i: int) -> tuple:
        found = self._file.read(i)
        return *self._file.of_sites(found), found.cell, found.time, found.step


class _WithTimes(ProtoReader):
    """Mixin for a reader that returns the times of the run (ps), evenly spaced or not, instead of those in the file."""

    def __init__(self, *source, times: list[float], **options):
        self._times = times
        self._dt = float(times[1] - times[0]) if len(times) > 1 else 0.0
        super().__init__(*source, **options | {"times": times})  # a reader passes its options to its copies
        self._set_time(self.ts)

    @property
    def totaltime(self) -> float:
        return self._times[-1] - self._times[0]

    def _set_time(self, frame):
        frame.time = self._times[frame.frame]
        frame.dt = self._dt
        return frame

    def _read_frame(self, i):
        return self._set_time(super()._read_frame(i))

    def _read_next_timestep(self, ts=None):
        # every reader implements it
        return self._set_time(super()._read_next_timestep(ts))  # pyright: ignore[reportAbstractUsage]


def _with_times(reader: Any) -> Any:
    """A subclass of a reader with the times of the run. It is a name of this module, so that readers can be pickled."""
    name = f"Timed{reader.__name__}"
    globals()[name] = type(reader)(name, (_WithTimes, reader), {"__module__": __name__})
    return globals()[name]


TimedFrames = _with_times(MemoryReader)
#: Readers by extension, and MDAnalysis' name of a format, or the reader, if it is not the extension.
TIMED = {
    ".xtc": _with_times(XTCReader), ".trr": _with_times(TRRReader), ".gsd": _with_times(GsdSiteReader),
    ".traj": _with_times(TrajSiteReader), ".dcd": _with_times(DCDReader), ".nc": _with_times(NCDFReader),
    ".xyz": _with_times(XYZReader), ".pdb": _with_times(PDBReader),
}  # fmt: skip
FORMATS = {".nc": "NCDF", ".gsd": GsdSiteReader, ".traj": TrajSiteReader}
