"""Trajectories and topology files through MDAnalysis. The only room that imports it."""

import ctypes
import os
import warnings
from math import inf
from pathlib import Path
from typing import Any

import MDAnalysis as mda
import numpy as np
from MDAnalysis.coordinates.base import ProtoReader
from MDAnalysis.coordinates.DCD import DCDReader
from MDAnalysis.coordinates.memory import MemoryReader
from MDAnalysis.coordinates.PDB import PDBReader
from MDAnalysis.coordinates.TRJ import NCDFReader
from MDAnalysis.coordinates.TRR import TRRReader
from MDAnalysis.coordinates.XTC import XTCReader
from MDAnalysis.coordinates.XYZ import XYZReader

from rigidmd.assemble.body import BodySystem
from rigidmd.assemble.cells import angles_deg
from rigidmd.assemble.system import System
from rigidmd.core.files import whole_file
from rigidmd.core.state import State
from rigidmd.errors import SimulationError
from rigidmd.output.frame import Frame

#: Least and largest coordinate (Å) of a format, from 32-bit integers of 0.001 nm or columns of text.
LIMITS = {".xtc": (-2e7, 2e7), ".gro": (-9999.9, 99999.9), ".pdb": (-999.99, 9999.99)}
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
    set_frame(u, system, state, 0.0, 0, velocities, wrapped)
    return u


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
    u.trajectory = _TimedFrames(positions, times=times, order="fac", dimensions=boxes)
    return u


def from_files(topology: Path, trajectory: Path, times: list[float]) -> mda.Universe:
    """The Universe of a finished run's files, whose frames have these times (ps)."""
    return mda.Universe(str(topology), str(trajectory), format=TIMED[trajectory.suffix], times=_checked(times))


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
        sites.write(str(temporary))


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

    interval : time between frames (ps); only .dcd uses it, which stores it once for all frames.
    """

    def __init__(self, path: Path, system: System | BodySystem, interval: float, velocities: bool, wrapped: bool):
        self._system = system
        self._velocities = velocities
        self._wrapped = wrapped
        self._universe = universe(system, system.state, velocities)
        options = {".dcd": {"dt": interval}, ".nc": {"velocities": velocities}, ".pdb": {"multiframe": True}}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self._writer: Any = mda.Writer(str(path), n_atoms=len(system.sites.name), **options.get(path.suffix, {}))
        self._path, self._format = path, path.suffix

    def write(self, state: State, time: float, step: int) -> None:
        """Add a frame with its own time (ps) and the box."""
        set_frame(self._universe, self._system, state, time, step, self._velocities, self._wrapped)
        _check_fits(self._path, self._universe.trajectory.ts.positions)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if self._format == ".xyz":
                self._writer.remark = _extended_xyz(state.cell, time)
            elif self._format == ".pdb":
                self._writer.REMARK(f"TIME {time:.6f} PS")
            self._writer.write(self._universe.atoms)
            if self._format == ".pdb" and (box := dimensions(state.cell)):
                self._writer.CRYST1(box)  # MDAnalysis assigns lines between two models to the first
        self._flush()

    def _flush(self) -> None:
        """Flush the frame to disk, so that a killed run leaves whole frames."""
        for name in ("_xyz", "pdbfile"):
            if (file := getattr(self._writer, name, None)) is not None:
                file.flush()
        if os.name == "posix":  # the writers of XTC and TRR cannot flush their C streams: flush all streams
            ctypes.CDLL(None).fflush(None)

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()


def _extended_xyz(cell: np.ndarray, time: float) -> str:
    """Comment line of extended XYZ, which OVITO and ASE read: box and time."""
    box = 'pbc="F F F"'
    if cell[0, 0] < inf:
        edges = " ".join(f"{x:.9g}" for x in cell.flat)
        box = f'Lattice="{edges}" pbc="T T T"'
    return f"{box} Properties=species:S:1:pos:R:3 Time={time:.9g}"
