"""Writers of the trajectories and topology files of a run."""

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

from rigidmd.core.files import AppendedFile, atomic_file
from rigidmd.core.process import ignore_warnings
from rigidmd.core.state import State
from rigidmd.engines.body_system import BodySystem
from rigidmd.engines.system import System
from rigidmd.errors import SimulationError
from rigidmd.io.formats.gsd import GsdFile
from rigidmd.io.formats.traj import TrajFile
from rigidmd.io.trajectory import dimensions, set_frame, universe
from rigidmd.io.write import writing

NM_PER_A, XTC_PER_NM = 0.1, 1000.0
#: Smallest and largest coordinate (Å) of a format, due to 32-bit integers of 0.001 nm or to columns of text.
LIMITS = {".xtc": (-2e7, 2e7), ".gro": (-9999.9, 99999.9), ".pdb": (-999.99, 9999.99)}


def open_trajectory(
    path: Path, system: System | BodySystem, interval: float, velocities: bool, wrapped: bool,
    kept: Sequence[int] | None = None
) -> "TrajectoryFile | GsdFile | TrajFile":  # fmt: skip
    """The trajectory file for the extension of a path. For the arguments see `TrajectoryFile`."""
    if (kind := {".gsd": GsdFile, ".traj": TrajFile}.get(path.suffix)) is not None:
        if not isinstance(system, System):
            raise TypeError(f"{path.suffix} files are for molecules only")
        return kind(path, system, velocities, wrapped, kept)
    return TrajectoryFile(path, system, interval, velocities, wrapped, kept)


def write_topology(path: Path, system: System | BodySystem, state: State, wrapped: bool) -> None:
    """Write names, molecules and first positions, which viewers need next to a trajectory. Raises SimulationError if
    the format cannot hold a position."""
    _check_fits(path, system.site_positions(state, wrapped))
    with atomic_file(path) as temporary, ignore_warnings():  # of missing attributes (occupancies, ...)
        sites = universe(system, state, wrapped=wrapped).select_atoms("all")
        sites.write(str(temporary), **({"bonds": "all"} if path.suffix == ".pdb" else {}))


def _check_fits(path: Path, positions: np.ndarray) -> None:
    least, largest = LIMITS.get(path.suffix, (-inf, inf))
    for bound, beyond in ((least, positions.min() < least), (largest, positions.max() > largest)):
        if beyond:
            hint = "use .trr or .nc, output.positions = 'wrapped', or for a body a smaller output.trajectory_A_per_m"
            raise SimulationError(f"a position is beyond the {bound:g} Å that {path.suffix} can hold: {hint}")


class TrajectoryFile:
    """Writes frames to a trajectory, in the format of the file's extension.

    MDAnalysis writes each frame to a separate file in memory, whose bytes are appended to the trajectory. So every
    write is checked, a killed run leaves whole frames, and a resumed run can continue the file.

    interval : time between frames (ps), for .dcd, which stores it once for all frames
    kept : earlier value of the property `kept`, from which `cut` continues the file; None begins a new file
    Raises OutputError, here and in every method.
    """

    def __init__(
        self, path: Path, system: System | BodySystem, interval: float, velocities: bool, wrapped: bool,
        kept: Sequence[int] | None = None
    ):  # fmt: skip
        self._path, self._format, self._system = path, path.suffix, system
        self._velocities, self._wrapped = velocities, wrapped
        self._universe = universe(system, system.state, velocities)
        pdb = {"multiframe": True, "bonds": None}  # bonds are in the topology
        options = {".dcd": {"dt": interval}, ".nc": {"velocities": velocities}, ".pdb": pdb}
        self._options = options.get(path.suffix, {})
        *before, self._frames = kept or (0, 0, 0)
        offset, form = COUNTER.get(path.suffix, (0, ""))
        patched = (offset, struct.pack(form, 1)) if form else (0, b"")
        self._file = AppendedFile(path, before if kept else None, patched)

    @property
    def kept(self) -> tuple[int, int, int]:
        """Number of bytes, all on the disk, their checksum, and the number of frames."""
        return *self._file.kept, self._frames

    def write(self, state: State, time: float, step: int) -> None:
        """Add a frame with its own time (ps) and the box."""
        if self._format in (".xtc", ".trr"):  # as GROMACS, which has 32 bits of the step
            step = (step + 2**31) % 2**32 - 2**31
        with writing(self._path):  # memory for the file of a frame may be insufficient
            if self._format == ".xtc":
                piece = self._xtc_frame(state, time, step)
            else:
                set_frame(self._universe, self._system, state, time, step, self._velocities, self._wrapped)
                _check_fits(self._path, self._universe.trajectory.ts.positions)
                piece = self._part_to_append(self._file_of_frame(state, time))
        self._file.append(piece)
        self._frames += 1
        if self._format in COUNTER:
            offset, form = COUNTER[self._format]
            self._file.patch(offset, struct.pack(form, self._frames))

    def cut(self) -> None:
        """Leave out the frames after the checkpoint."""
        self._file.cut()

    def close(self) -> None:
        self._file.close()

    def _xtc_frame(self, state: State, time: float, step: int) -> bytes:
        """A frame of .xtc with the same bytes as from MDAnalysis' writer, in half the time."""
        positions = self._system.site_positions(state, self._wrapped).astype(np.float32)
        _check_fits(self._path, positions)
        positions *= NM_PER_A
        box = NM_PER_A * state.cell if state.cell[0, 0] < inf else np.zeros((3, 3))
        with _scratch(self._path) as path:
            with XTCFile(path, "w") as file:
                file.write(positions, box.astype(np.float32), step, time, XTC_PER_NM)
            return _content(path)

    def _file_of_frame(self, state: State, time: float) -> bytes:
        """The content of a file with only the present frame."""
        options = self._options | ({"start": self._frames} if self._format == ".pdb" else {})
        with _scratch(self._path) as path, ignore_warnings():
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

    def _part_to_append(self, whole: bytes) -> bytes:
        """The bytes to append: the frame, and before the first frame the head of the file."""
        n, first = len(self._system.sites.name), self._frames == 0
        if self._format == ".pdb":
            # the time, the box, the model, but no END, which readers count as a further frame
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


#: Position of the number of frames in a file: offset and `struct` format.
COUNTER = {".dcd": (8, "<i"), ".nc": (4, ">i")}


@contextlib.contextmanager
def _scratch(path: Path) -> Iterator[str]:
    """A path for the file of a frame: in memory on Linux, elsewhere a hidden file next to the trajectory."""
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
    """The comment line of extended XYZ (for OVITO and ASE): box and time."""
    box = 'pbc="F F F"'
    if cell[0, 0] < inf:
        edges = " ".join(f"{x:.9g}" for x in cell.flat)
        box = f'Lattice="{edges}" pbc="T T T"'
    return f"{box} Properties=species:S:1:pos:R:3 Time={time:.9g}"
