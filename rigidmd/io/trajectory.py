"""MDAnalysis Universes of runs, and reading of trajectories through MDAnalysis."""

import contextlib
import re
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import MDAnalysis as mda
import numpy as np
from MDAnalysis.coordinates.core import reader as open_reader
from MDAnalysis.lib.distances import minimize_vectors, self_capped_distance

from rigidmd.core.process import ignore_warnings
from rigidmd.core.state import State
from rigidmd.engines.body_system import BodySystem
from rigidmd.engines.system import System
from rigidmd.errors import OutputError, StructureError
from rigidmd.io.atoms import Frame
from rigidmd.io.bonds import charges, connections
from rigidmd.io.folder import offsets_of
from rigidmd.io.formats.gsd import GsdReader
from rigidmd.io.formats.trajectory_frames import read_in_process
from rigidmd.io.mdanalysis_readers import FORMATS, TIMED, TimedFrames, dimensions

#: Lines with the cell and the time of a frame in text formats.
BETWEEN_FRAMES = {".xyz": rb'(?:Lattice="([^"]*)" )?pbc=.* Time=(\S+)', ".pdb": rb"^REMARK +()TIME +(\S+) PS"}
#: Frames are evenly spaced if intervals differ by less than this fraction of the longest.
EVEN = 1e-6


def universe(system: System | BodySystem, state: State, velocities: bool = False, wrapped: bool = True) -> mda.Universe:
    """An MDAnalysis Universe of all sites, one residue per molecule, with one frame of this state."""
    names = system.residue_names
    u = mda.Universe.empty(
        len(system.sites.molecule), n_residues=len(names), atom_resindex=system.sites.molecule, trajectory=True,
        velocities=velocities,
    )  # fmt: skip
    sites = system.sites
    attributes = {"names": sites.name, "types": sites.element, "elements": sites.element, "masses": sites.mass}
    for name, values in (attributes | {"resnames": names, "resids": np.arange(1, len(names) + 1)}).items():
        u.add_TopologyAttr(name, values)
    _connect(u, system, massless=False)  # viewers would draw these bonds
    set_frame(u, system, state, 0.0, 0, velocities, wrapped)
    return u


def _connect(u: mda.Universe, system: System | BodySystem, massless: bool = True) -> None:
    """Add charges and bonds; earlier bonds are replaced."""
    if hasattr(u.atoms, "bonds"):
        u.del_TopologyAttr("bonds")
    u.add_TopologyAttr("charges", charges(system))
    u.add_TopologyAttr("bonds", [tuple(pair) for pair in connections(system, massless).tolist()])


def set_frame(
    u: mda.Universe, system: System | BodySystem, state: State, time: float, step: int, velocities: bool, wrapped: bool
):
    frame = u.trajectory.ts
    frame.positions = system.site_positions(state, wrapped)
    if velocities:
        frame.velocities = system.site_velocities(state)
    frame.dimensions = dimensions(state.cell)
    frame.time = time
    frame.data["step"] = step


def in_memory(system: System | BodySystem, frames: list[Frame]) -> mda.Universe:
    """A Universe of frames in memory, each with its time and box."""
    u = universe(system, system.state)
    _connect(u, system)
    times, positions = _checked([frame.time for frame in frames]), np.array([frame.positions for frame in frames])
    boxes = [dimensions(frame.cell) for frame in frames if frame.cell is not None]
    boxes = None if u.dimensions is None else np.array(boxes)
    velocities = np.array([frame.velocities for frame in frames])
    u.trajectory = TimedFrames(positions, times=times, order="fac", dimensions=boxes, velocities=velocities)
    return u


def from_files(system: System | BodySystem, topology: Path, trajectory: Path, times: list[float]) -> mda.Universe:
    """The Universe of a finished run's files, with these times (ps) of its frames, and elements, masses and bonds."""
    _drop_links(trajectory)
    u = mda.Universe(str(topology), str(trajectory), format=TIMED[trajectory.suffix], times=_checked(times))
    u.add_TopologyAttr("elements", system.sites.element)
    u.add_TopologyAttr("masses", system.sites.mass)
    _connect(u, system)
    return u


def _checked(times: list[float]) -> list[float]:
    """The times, with a warning if they are not evenly spaced."""
    gaps = np.diff(times)
    if len(gaps) and np.ptp(gaps) > EVEN * gaps.max():
        spacing = f"frames are not evenly spaced ({gaps.min():g} to {gaps.max():g} ps)"
        warnings.warn(f"{spacing}: dt is the first of these; use the time of each frame (ts.time)", stacklevel=4)
    return times


class Frames(NamedTuple):
    time: np.ndarray  # (f,) ps
    positions: np.ndarray  # (f, s, 3) Å
    cells: np.ndarray | None  # (f, 3, 3); None without a box
    count: int  # frames in the file
    stride: int  # number of frames in the file per frame here
    is_cut: bool  # whether the file ends within a frame
    velocities: np.ndarray | None = None  # (f, s, 3) Å/ps; None if the file has none


def read_frames(path: Path, sites: int, most: int) -> Frames:
    """At most `most` evenly spaced frames of a trajectory. An incomplete last frame is left out. Raises OutputError if
    the file cannot be read, or has another number of sites."""
    if path.suffix == ".xtc":  # a damaged file crashes the library of its reader
        try:
            read_in_process(path, 0, sites)
        except StructureError as error:
            raise OutputError(str(error)) from None
    with _quiet():
        try:
            return _frames(path, sites, most)
        except (OSError, EOFError, ValueError, TypeError, IndexError, StopIteration) as error:
            reason = " ".join(str(error).split())
    raise OutputError(f"{path} cannot be read as a trajectory: {reason}")


def _frames(path: Path, sites: int, most: int) -> Frames:
    _drop_links(path)
    reader: Any = open_reader(str(path), format=FORMATS.get(path.suffix, path.suffix[1:]))
    with contextlib.closing(reader):
        if reader.n_atoms != sites:
            raise OutputError(f"{path} is not the trajectory of this run: {reader.n_atoms} sites, must be {sites}")
        count, is_cut = reader.n_frames, False
        stride = max(1, -(-count // most))
        selected = range(0, count, stride)
        times, boxes = [], []
        positions = np.empty((len(selected), sites, 3), np.float32)
        velocities = np.empty_like(positions) if count and reader.ts.has_velocities else None
        for n, k in enumerate(selected):
            try:
                frame = reader[k]
            except (OSError, EOFError, ValueError):
                if k + stride < count:  # not the last frame
                    raise OutputError(f"{path}: frame {k + 1} of {count} is not one of {sites} sites") from None
                is_cut = True
                break
            times.append(frame.time)
            positions[n] = frame.positions
            boxes.append(None if frame.dimensions is None else frame.triclinic_dimensions)
            if velocities is not None:
                velocities[n] = frame.velocities
    if not times:
        raise OutputError(f"{path} holds no whole frame")
    text_times, text_cells = _times_and_cells_in_text(path)
    if text_times:
        times = text_times[::stride][: len(times)]
    cells = np.array(boxes) if all(box is not None for box in boxes) else None
    if text_cells:
        cells = np.array(text_cells[::stride][: len(times)])
    moving = None if velocities is None else velocities[: len(times)]
    return Frames(np.array(times), positions[: len(times)], cells, count, stride, is_cut, moving)


def _times_and_cells_in_text(path: Path) -> tuple[list[float], list[np.ndarray]]:
    """Times (ps) and cells (3, 3) in lines between the frames of .xyz and .pdb, which MDAnalysis ignores."""
    times, cells, pattern = [], [], BETWEEN_FRAMES.get(path.suffix)
    if pattern is None:
        return times, cells
    with path.open("rb") as file:
        for line in file:
            if (b"Time=" in line or line.startswith(b"REMARK")) and (found := re.search(pattern, line)):
                times.append(float(found[2]))
                if found[1]:
                    cells.append(np.array(found[1].split(), float).reshape(3, 3))
    return times, cells


def _drop_links(path: Path) -> None:
    """Remove symbolic links that MDAnalysis would follow when it writes offsets next to a trajectory."""
    for offsets in offsets_of(path):
        if offsets.is_symlink():
            offsets.unlink()


def read_rotations(path: Path) -> np.ndarray:
    """Q of all molecules at all frames (frames, n, 3, 3) of a .gsd file. Raises OutputError if it cannot be read."""
    try:
        with contextlib.closing(GsdReader(path)) as reader:
            return np.array([reader.read(k).rotation() for k in range(reader.count)])
    except (OSError, ValueError) as error:
        raise OutputError(f"{path} cannot be read: {error}") from None


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence the warnings of readers, also of one that could not open its file, when it is deleted."""
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        with ignore_warnings():
            yield
    finally:
        sys.unraisablehook = hook


def near_pairs(at: np.ndarray, cell: np.ndarray | None, distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (p, 2) of points (k, 3) closer than `distance`, in a cell (3, 3) or without a box, and the vectors (p, 3)
    from the first to the second; Å, single precision."""
    box = None if cell is None else np.array(dimensions(cell), np.float32)
    pairs = self_capped_distance(at.astype(np.float32), distance, box=box, return_distances=False)
    vectors = (at[pairs[:, 1]] - at[pairs[:, 0]]).astype(np.float32)
    return pairs, vectors if box is None else minimize_vectors(vectors, box)
