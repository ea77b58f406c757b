"""Trajectories and topology files through MDAnalysis. The only room that imports it."""

import contextlib
import os
import re
import struct
import sys
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

import MDAnalysis as mda
import numpy as np
from MDAnalysis.coordinates.base import ProtoReader
from MDAnalysis.coordinates.core import reader as open_reader
from MDAnalysis.coordinates.DCD import DCDReader
from MDAnalysis.coordinates.memory import MemoryReader
from MDAnalysis.coordinates.PDB import PDBReader
from MDAnalysis.coordinates.TRJ import NCDFReader
from MDAnalysis.coordinates.TRR import TRRReader
from MDAnalysis.coordinates.XTC import XTCReader
from MDAnalysis.coordinates.XYZ import XYZReader
from MDAnalysis.lib.distances import minimize_vectors, self_capped_distance

from rigidmd.assemble.body import BodySystem
from rigidmd.assemble.cells import angles_deg
from rigidmd.assemble.system import System
from rigidmd.core.files import AppendedFile, whole_file
from rigidmd.core.state import State
from rigidmd.errors import OutputError, SimulationError
from rigidmd.output.connections import charges, connections
from rigidmd.output.frame import Frame

#: Least and largest coordinate (Å) of a format, from 32-bit integers of 0.001 nm or columns of text.
LIMITS = {".xtc": (-2e7, 2e7), ".gro": (-9999.9, 99999.9), ".pdb": (-999.99, 9999.99)}
#: Lines that tell the cell and the time of a frame in formats of text.
BETWEEN_FRAMES = {
    ".xyz": rb'(?:Lattice="([^"]*)" )?pbc=.* Time=(\S+)',
    ".pdb": rb"^REMARK +()TIME +(\S+) PS",
}
#: Frames are evenly spaced if intervals differ by less than this fraction of the longest.
EVEN = 1e-6


def universe(system: System | BodySystem, state: State, velocities: bool = False, wrapped: bool = True) -> mda.Universe:
    """An MDAnalysis Universe of all sites, one residue per molecule, with one frame of this state."""
    names = system.residue_names
    u = mda.Universe.empty(
        len(system.sites.molecule),
        n_residues=len(names),
        atom_resindex=system.sites.molecule,
        trajectory=True,
        velocities=velocities,
    )
    u.add_TopologyAttr("names", system.sites.name)
    u.add_TopologyAttr("types", system.sites.element)
    u.add_TopologyAttr("elements", system.sites.element)
    u.add_TopologyAttr("masses", system.sites.mass)
    u.add_TopologyAttr("resnames", names)
    u.add_TopologyAttr("resids", np.arange(1, len(names) + 1))
    _connect(u, system)
    set_frame(u, system, state, 0.0, 0, velocities, wrapped)
    return u


def _connect(u: mda.Universe, system: System | BodySystem) -> None:
    """Add charges and bonds."""
    u.add_TopologyAttr("charges", charges(system))
    u.add_TopologyAttr("bonds", [tuple(pair) for pair in connections(system).tolist()])


def set_frame(
    u: mda.Universe, system: System | BodySystem, state: State, time: float, step: int, velocities: bool, wrapped: bool
):
    """Put a state into the universe's present frame."""
    frame = u.trajectory.ts
    frame.positions = system.site_positions(state, wrapped)
    if velocities:
        frame.velocities = system.site_velocities(state)
    frame.dimensions = dimensions(state.cell)
    frame.time = time
    frame.data["step"] = step


def dimensions(cell: np.ndarray) -> list[float] | None:
    """A cell (3, 3) in MDAnalysis' form; None without a box."""
    if cell[0, 0] == inf:
        return None
    return [*np.linalg.norm(cell, axis=1), *angles_deg(cell)]


def in_memory(system: System | BodySystem, frames: list[Frame]) -> mda.Universe:
    """A Universe that holds frames in memory, each with its own time and box."""
    u = universe(system, system.state)
    times, positions = _checked([frame.time for frame in frames]), np.array([frame.positions for frame in frames])
    boxes = (
        None
        if u.dimensions is None
        else np.array([dimensions(frame.cell) for frame in frames if frame.cell is not None])
    )
    velocities = np.array([frame.velocities for frame in frames])
    u.trajectory = _TimedFrames(positions, times=times, order="fac", dimensions=boxes, velocities=velocities)
    return u


def from_files(system: System | BodySystem, topology: Path, trajectory: Path, times: list[float]) -> mda.Universe:
    """The Universe of a finished run's files, whose frames have these times (ps), with all that its system tells."""
    u = mda.Universe(str(topology), str(trajectory), format=TIMED[trajectory.suffix], times=_checked(times))
    u.add_TopologyAttr("elements", system.sites.element)
    u.add_TopologyAttr("masses", system.sites.mass)
    if hasattr(u.atoms, "bonds"):  # a .pdb's
        u.del_TopologyAttr("bonds")
    _connect(u, system)
    return u


def _checked(times: list[float]) -> list[float]:
    """The times, with a warning if they are not evenly spaced."""
    gaps = np.diff(times)
    if len(gaps) and np.ptp(gaps) > EVEN * gaps.max():
        warnings.warn(
            f"frames are not evenly spaced ({gaps.min():g} to {gaps.max():g} ps): dt is the first that is not 0; "
            "use the time of each frame (ts.time)",
            stacklevel=4,
        )
    return times


class Frames(NamedTuple):
    """Frames of a trajectory: times (f,) ps, positions (f, s, 3) Å, cells (f, 3, 3), None without a box, and velocities
    (f, s, 3) Å/ps, None where the file has none.

    stride : which frames of the file these are: every one, every second, ...
    is_cut : whether the file ends within a frame
    """

    time: np.ndarray
    positions: np.ndarray
    cells: np.ndarray | None
    count: int  # frames in the file
    stride: int
    is_cut: bool
    velocities: np.ndarray | None = None


def read_frames(path: Path, sites: int, most: int) -> Frames:
    """At most so many evenly spaced frames of a trajectory. A last frame that is cut off is left out.

    Raises OutputError if the file cannot be read, or holds another number of sites.
    """
    fault = ""
    with _quiet():
        try:
            return _frames(path, sites, most)
        except (OSError, EOFError, ValueError, TypeError, IndexError, StopIteration) as error:
            fault = " ".join(str(error).split())
    raise OutputError(f"{path} cannot be read as a trajectory: {fault}")


def _frames(path: Path, sites: int, most: int) -> Frames:
    reader: Any = open_reader(str(path), format="NCDF" if path.suffix == ".nc" else path.suffix[1:])
    with contextlib.closing(reader):
        if reader.n_atoms != sites:
            raise OutputError(f"{path} is not the trajectory of this run: {reader.n_atoms} sites, must be {sites}")
        count, is_cut = reader.n_frames, False
        stride = max(1, -(-count // most))
        chosen = range(0, count, stride)
        times, boxes = [], []
        positions = np.empty((len(chosen), sites, 3), np.float32)
        velocities = np.empty_like(positions) if count and reader.ts.has_velocities else None
        for place, k in enumerate(chosen):
            try:
                frame = reader[k]
            except (OSError, EOFError, ValueError):
                is_cut = True
                break
            times.append(frame.time)
            positions[place] = frame.positions
            boxes.append(None if frame.dimensions is None else frame.triclinic_dimensions)
            if velocities is not None:
                velocities[place] = frame.velocities
    if not times:
        raise OutputError(f"{path} holds no whole frame")
    told_times, told_cells = _told_in_text(path)
    if told_times:
        times = told_times[::stride][: len(times)]
    cells = np.array(boxes) if all(box is not None for box in boxes) else None
    if told_cells:
        cells = np.array(told_cells[::stride][: len(times)])
    moving = None if velocities is None else velocities[: len(times)]
    return Frames(np.array(times), positions[: len(times)], cells, count, stride, is_cut, moving)


def _told_in_text(path: Path) -> tuple[list[float], list[np.ndarray]]:
    """Times (ps) and cells (3, 3) that lines between frames of .xyz and .pdb tell, which MDAnalysis passes by."""
    pattern = BETWEEN_FRAMES.get(path.suffix)
    if pattern is None:
        return [], []
    times, cells = [], []
    with path.open("rb") as file:
        for line in file:
            if (b"Time=" in line or line.startswith(b"REMARK")) and (found := re.search(pattern, line)):
                times.append(float(found[2]))
                if found[1]:
                    cells.append(np.array(found[1].split(), float).reshape(3, 3))
    return times, cells


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence the warnings of readers, and what one that could not open its file says when it is removed."""
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        sys.unraisablehook = hook


def near_pairs(at: np.ndarray, cell: np.ndarray | None, distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (p, 2) of points (k, 3) that are closer than `distance`, in a cell (3, 3) or without a box, and the way
    (p, 3) from the first to the second; Å, single precision."""
    box = None if cell is None else np.array(dimensions(cell), np.float32)
    pairs = self_capped_distance(at.astype(np.float32), distance, box=box, return_distances=False)
    ways = (at[pairs[:, 1]] - at[pairs[:, 0]]).astype(np.float32)
    return pairs, ways if box is None else minimize_vectors(ways, box)


class _Timed(ProtoReader):
    """Makes a reader return the times of the run (ps), evenly spaced or not, whatever its file holds."""

    def __init__(self, *source, times: list[float], **options):
        self._times = times
        # two frames at one time: before and after a minimisation
        self._dt = float(next((gap for gap in np.diff(times) if gap > 0), 0.0))
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


class _TimedFrames(_Timed, MemoryReader): ...


class _TimedXTC(_Timed, XTCReader): ...


class _TimedTRR(_Timed, TRRReader): ...


class _TimedDCD(_Timed, DCDReader): ...


class _TimedNCDF(_Timed, NCDFReader): ...


class _TimedXYZ(_Timed, XYZReader): ...


class _TimedPDB(_Timed, PDBReader): ...


TIMED = {
    ".xtc": _TimedXTC, ".trr": _TimedTRR, ".dcd": _TimedDCD, ".nc": _TimedNCDF, ".xyz": _TimedXYZ, ".pdb": _TimedPDB,
}  # fmt: skip


def write_topology(path: Path, system: System | BodySystem, state: State, wrapped: bool) -> None:
    """Write names, molecules and first positions, which viewers need beside a trajectory.

    Raises SimulationError if the format cannot hold a position.
    """
    _check_fits(path, system.site_positions(state, wrapped))
    with whole_file(path) as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of missing attributes (occupancies, ...)
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
    kept : `kept` of an earlier time, at which an existing file goes on; None begins a new file
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
        set_frame(self._universe, self._system, state, time, step, self._velocities, self._wrapped)
        _check_fits(self._path, self._universe.trajectory.ts.positions)
        self._file.append(self._part_of(self._whole(state, time)))
        self._frames += 1
        if self._format in COUNTER:
            offset, form = COUNTER[self._format]
            self._file.patch(offset, struct.pack(form, self._frames))

    def close(self) -> None:
        """Finish the file."""
        if self._format == ".pdb":
            self._file.append(PDB_END)
        self._file.close()

    def _whole(self, state: State, time: float) -> bytes:
        """The file that has the present frame alone."""
        options = self._options | ({"start": self._frames} if self._format == ".pdb" else {})
        with _scratch(self._path) as path, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            form = "NCDF" if self._format == ".nc" else self._format[1:].upper()
            writer: Any = mda.Writer(path, n_atoms=len(self._system.sites.name), format=form, **options)
            with writer:
                if self._format == ".xyz":
                    writer.remark = _extended_xyz(state.cell, time)
                elif self._format == ".pdb":
                    writer.REMARK(f"TIME {time:.6f} PS")
                writer.write(self._universe.atoms)
                if self._format == ".pdb" and (box := dimensions(state.cell)):
                    writer.CRYST1(box)  # MDAnalysis assigns lines between two models to the first
            return Path(path).read_bytes()

    def _part_of(self, whole: bytes) -> bytes:
        """What is added to the trajectory: the frame, before the first one with the head of the file."""
        n, first = len(self._system.sites.name), self._frames == 0
        if self._format == ".pdb":
            lines = whole.removesuffix(PDB_END)
            model = lines.index(b"MODEL ")
            return lines if first else lines[: lines.index(b"\n") + 1] + lines[model:]
        if self._format == ".xyz":
            return whole.removesuffix(b"\n\n") + b"\n"
        if first or self._format not in COUNTER:
            return whole
        boxed = self._universe.dimensions is not None
        size = 80 + 12 * n if self._format == ".dcd" else 4 + 12 * n * (1 + self._velocities) + 48 * boxed
        return whole[-size:]


#: Where a format counts its frames: offset and how the number is packed.
COUNTER = {".dcd": (8, "<i"), ".nc": (4, ">i")}
PDB_END = b"END\n"


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


def _extended_xyz(cell: np.ndarray, time: float) -> str:
    """Comment line of extended XYZ, which OVITO and ASE read: box and time."""
    box = 'pbc="F F F"'
    if cell[0, 0] < inf:
        edges = " ".join(f"{x:.9g}" for x in cell.flat)
        box = f'Lattice="{edges}" pbc="T T T"'
    return f"{box} Properties=species:S:1:pos:R:3 Time={time:.9g}"
