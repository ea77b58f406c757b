"""Trajectories and topology files as a run writes them, through MDAnalysis."""

import contextlib
import os
import struct
import tempfile
from collections.abc import Iterator, Sequence
from math import inf
from pathlib import Path
from typing import Any

import MDAnalysis as mda
import numpy as np
from MDAnalysis.lib.formats.libmdaxdr import XTCFile

from rigidmd.core.files import AppendedFile, whole_file
from rigidmd.core.process import quiet
from rigidmd.core.state import State
from rigidmd.engines.body_system import BodySystem
from rigidmd.engines.system import System
from rigidmd.errors import SimulationError
from rigidmd.io.formats.gsd_writer import GsdFile
from rigidmd.io.formats.traj_writer import TrajFile
from rigidmd.io.trajectory import dimensions, set_frame, universe
from rigidmd.io.write import writing

NM_PER_A, XTC_PER_NM = 0.1, 1000.0
#: Least and largest coordinate (Å) of a format, from 32-bit integers of 0.001 nm or columns of text.
LIMITS = {".xtc": (-2e7, 2e7), ".gro": (-9999.9, 99999.9), ".pdb": (-999.99, 9999.99)}


def open_trajectory(
    path: Path,
    system: System | BodySystem,
    interval: float,
    velocities: bool,
    wrapped: bool,
    kept: Sequence[int] | None = None,
) -> "TrajectoryFile | GsdFile | TrajFile":
    """The file that frames go to, which the ending chooses; for the arguments see `TrajectoryFile`."""
    if (kind := {".gsd": GsdFile, ".traj": TrajFile}.get(path.suffix)) is not None:
        if not isinstance(system, System):
            raise TypeError(f"a {path.suffix} file is of molecules")
        return kind(path, system, velocities, wrapped, kept)
    return TrajectoryFile(path, system, interval, velocities, wrapped, kept)


def write_topology(path: Path, system: System | BodySystem, state: State, wrapped: bool) -> None:
    """Write names, molecules and first positions, which viewers need beside a trajectory.

    Raises SimulationError if the format cannot hold a position.
    """
    _check_fits(path, system.site_positions(state, wrapped))
    with whole_file(path) as temporary, quiet():  # of missing attributes (occupancies, ...)
        sites = universe(system, state, wrapped=wrapped).select_atoms("all")
        sites.write(str(temporary), **({"bonds": "all"} if path.suffix == ".pdb" else {}))


def _check_fits(path: Path, positions: np.ndarray) -> None:
    least, largest = LIMITS.get(path.suffix, (-inf, inf))
    for bound, beyond in ((least, positions.min() < least), (largest, positions.max() > largest)):
        if beyond:
            raise SimulationError(
                f"a position is beyond the {bound:g} Å that {path.suffix} can hold: use .trr or .nc, "
                "output.positions = 'wrapped', or of a body less output.trajectory_A_per_m"
            )


class TrajectoryFile:
    """Writes frames to a file as they come. The ending sets the format.

    MDAnalysis writes each frame to a file of its own in memory; its bytes go to the end of the trajectory. So every
    write is checked, a file that ends early ends with a whole frame, and a run can go on with the file of another.

    interval : time between frames (ps); only .dcd uses it, which stores it once for all frames
    kept : `kept` of an earlier time, at which an existing file is continued after `cut`; None begins a new file
    Raises OutputError, here and in every method.
    """

    def __init__(
        self,
        path: Path,
        system: System | BodySystem,
        interval: float,
        velocities: bool,
        wrapped: bool,
        kept: Sequence[int] | None = None,
    ):
        self._path, self._format, self._system = path, path.suffix, system
        self._velocities, self._wrapped = velocities, wrapped
        self._universe = universe(system, system.state, velocities)
        forms = {
            ".dcd": {"dt": interval},
            ".nc": {"velocities": velocities},
            ".pdb": {"multiframe": True, "bonds": None},  # those of the topology do
        }
        self._options = forms.get(path.suffix, {})
        *before, self._frames = kept or (0, 0, 0)
        offset, form = COUNTER.get(path.suffix, (0, ""))
        patched = (offset, struct.pack(form, 1)) if form else (0, b"")
        self._file = AppendedFile(path, before if kept else None, patched)

    @property
    def kept(self) -> tuple[int, int, int]:
        """Bytes so far, all of them on the disk, their checksum, and the number of frames."""
        return *self._file.kept, self._frames

    def write(self, state: State, time: float, step: int) -> None:
        """Add a frame with its own time (ps) and the box."""
        if self._format in (".xtc", ".trr"):  # as GROMACS does: 32 bits of the step, the time is what counts
            step = (step + 2**31) % 2**32 - 2**31
        with writing(self._path):  # the file of a frame may find no room in memory
            if self._format == ".xtc":
                piece = self._xtc_frame(state, time, step)
            else:
                set_frame(self._universe, self._system, state, time, step, self._velocities, self._wrapped)
                _check_fits(self._path, self._universe.trajectory.ts.positions)
                piece = self._part_of(self._whole(state, time))
        self._file.append(piece)
        self._frames += 1
        if self._format in COUNTER:
            offset, form = COUNTER[self._format]
            self._file.patch(offset, struct.pack(form, self._frames))

    def cut(self) -> None:
        """Cut off the frames that came after the time of `kept`."""
        self._file.cut()

    def close(self) -> None:
        """Finish the file."""
        self._file.close()

    def _xtc_frame(self, state: State, time: float, step: int) -> bytes:
        """A frame of the most usual format, as MDAnalysis' writer makes it, in half of the time."""
        positions = self._system.site_positions(state, self._wrapped).astype(np.float32)
        _check_fits(self._path, positions)
        positions *= NM_PER_A
        box = NM_PER_A * state.cell if state.cell[0, 0] < inf else np.zeros((3, 3))
        with _scratch(self._path) as path:
            with XTCFile(path, "w") as file:
                file.write(positions, box.astype(np.float32), step, time, XTC_PER_NM)
            return _content(path)

    def _whole(self, state: State, time: float) -> bytes:
        """The file that has the present frame alone."""
        options = self._options | ({"start": self._frames} if self._format == ".pdb" else {})
        with _scratch(self._path) as path, quiet():
            form = "NCDF" if self._format == ".nc" else self._format[1:].upper()
            writer: Any = mda.Writer(path, n_atoms=len(self._system.sites.name), format=form, **options)
            with writer:
                if self._format == ".xyz":
                    writer.remark = _extended_xyz(state.cell, time)
                elif self._format == ".pdb":
                    writer.REMARK(f"TIME {time:.6f} PS")
                writer.write(self._universe.atoms)
                if self._format == ".pdb" and (box := dimensions(state.cell)):
                    writer.CRYST1(box)
            return _content(path)

    def _part_of(self, whole: bytes) -> bytes:
        """What is added to the trajectory: the frame, before the first one with the head of the file."""
        n, first = len(self._system.sites.name), self._frames == 0
        if self._format == ".pdb":
            # the time, the box, the model; no END, which readers take for the end of a further frame
            lines = whole.removesuffix(b"END\n").splitlines(keepends=True)
            model = next(k for k, line in enumerate(lines) if line.startswith(b"MODEL "))
            box = [line for line in lines[-1:] if line.startswith(b"CRYST1")]
            head = [line for line in lines[: model if first else 1] if not line.startswith(b"CRYST1")]
            return b"".join([*head, *box, *lines[model : len(lines) - len(box)]])
        if self._format == ".xyz":
            return whole.removesuffix(b"\n\n") + b"\n"
        if first or self._format not in COUNTER:
            return whole
        boxed = self._universe.dimensions is not None
        size = 80 + 12 * n if self._format == ".dcd" else 4 + 12 * n * (1 + self._velocities) + 48 * boxed
        return whole[-size:]


#: Where a format counts its frames: offset and how the number is packed.
COUNTER = {".dcd": (8, "<i"), ".nc": (4, ">i")}


@contextlib.contextmanager
def _scratch(path: Path) -> Iterator[str]:
    """A path to write one frame to: in memory on Linux, elsewhere a hidden file beside the trajectory."""
    if hasattr(os, "memfd_create"):
        handle = os.memfd_create(path.name)
        try:
            yield f"/proc/self/fd/{handle}"
        finally:
            os.close(handle)
    else:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".frame") as folder:
            yield str(Path(folder) / path.name)


def _content(path: str) -> bytes:
    with open(path, "rb", buffering=0) as file:
        return file.readall()


def _extended_xyz(cell: np.ndarray, time: float) -> str:
    """Comment line of extended XYZ, which OVITO and ASE read: box and time."""
    box = 'pbc="F F F"'
    if cell[0, 0] < inf:
        edges = " ".join(f"{x:.9g}" for x in cell.flat)
        box = f'Lattice="{edges}" pbc="T T T"'
    return f"{box} Properties=species:S:1:pos:R:3 Time={time:.9g}"
