"""Trajectories of runs, read from files of any format, and as MDAnalysis Universes."""

import contextlib
import functools
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar, cast

import MDAnalysis as mda
import numpy as np
from MDAnalysis.coordinates.base import ProtoReader, ReaderBase
from MDAnalysis.coordinates.core import get_reader_for
from MDAnalysis.coordinates.memory import MemoryReader
from MDAnalysis.coordinates.timestep import Timestep
from MDAnalysis.coordinates.XDR import XDRBaseReader
from MDAnalysis.lib.distances import minimize_vectors, self_capped_distance

from rigidmd.core.process import ignore_warnings
from rigidmd.core.state import State
from rigidmd.engines.sites import AnySystem
from rigidmd.errors import OutputError, StructureError
from rigidmd.formats import BY_EXTENSION
from rigidmd.formats.atoms import Frame
from rigidmd.formats.through_mdanalysis import (
    TrajectoryReader,
    dimensions,
    read_in_process,
    set_frame,
    universe_of,
)
from rigidmd.scene.validation import not_none

#: Frames are evenly spaced if intervals differ by less than this fraction of the longest.
EVEN = 1e-6

T = TypeVar("T")
Reader = TypeVar("Reader", bound=ProtoReader)


def universe(system: AnySystem, state: State, wrapped: bool = True) -> mda.Universe:
    """An MDAnalysis Universe of all sites, one residue per molecule, with one frame of this
    state."""
    u = universe_of(system)
    _connect(u, system, massless=False)  # viewers would draw these bonds
    set_frame(u.trajectory.ts, Frame(0.0, system.site_positions(state, wrapped), state.cell))
    return u


def _connect(u: mda.Universe, system: AnySystem, *, massless: bool = True) -> None:
    """Add charges and bonds. Earlier bonds are replaced."""
    if hasattr(u.atoms, "bonds"):
        u.del_TopologyAttr("bonds")
    u.add_TopologyAttr("charges", system.charges)
    u.add_TopologyAttr(
        "bonds", [tuple(pair) for pair in system.connections(massless=massless).tolist()]
    )


def in_memory(system: AnySystem, frames: Sequence[Frame]) -> mda.Universe:
    """A Universe of frames in memory, each with its time and box."""
    u = universe(system, system.state)
    _connect(u, system)
    times = _checked([frame.time for frame in frames])
    positions = np.array([frame.positions for frame in frames])
    boxes = None if u.dimensions is None else np.array([dimensions(frame.cell) for frame in frames])
    velocities = np.array([frame.velocities for frame in frames])
    u.trajectory = timed(MemoryReader)(
        positions, times=times, order="fac", dimensions=boxes, velocities=velocities
    )
    return u


def from_files(
    system: AnySystem, topology: Path, trajectory: Path, times: list[float]
) -> mda.Universe:
    """The Universe of a finished run's files, with these times (ps) of its frames, and elements,
    masses and bonds."""
    u = mda.Universe(
        str(topology),
        str(trajectory),
        format=timed(reader_of(trajectory.suffix)),
        times=_checked(times),
    )
    u.add_TopologyAttr("elements", system.sites.element)
    u.add_TopologyAttr("masses", system.sites.mass)
    _connect(u, system)
    return u


def _checked(times: list[float]) -> list[float]:
    """The times, with a warning if they are not evenly spaced."""
    gaps = np.diff(times)
    if len(gaps) and np.ptp(gaps) > EVEN * gaps.max():
        spacing = f"frames are not evenly spaced ({gaps.min():g} to {gaps.max():g} ps)"
        warnings.warn(
            f"{spacing}: dt is the first of these. Use the time of each frame (ts.time)",
            stacklevel=4,
        )
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
    """At most `most` evenly spaced frames of a trajectory. An incomplete last frame is left out.
    Raises OutputError if the file cannot be read, or has another number of sites."""
    return _read(_frames, path, sites, most)


def read_times(path: Path, sites: int) -> np.ndarray:
    """Times (f,) of the trajectory frames, ps, without the rounding of files. For errors see
    `read_frames`."""
    return without_rounding(np.array(_read(_times, path, sites)))


def without_rounding(time: np.ndarray) -> np.ndarray:
    """Times (f,) of frames without the rounding of files to single precision, if nothing else makes
    them uneven."""
    even = (
        np.linspace(_as_decimal(time[0]), _as_decimal(time[-1]), len(time)) if len(time) else time
    )
    rounding = np.spacing(np.abs(time).max(initial=0.0).astype(np.float32))
    return even if np.all(np.abs(even - time) <= 2 * rounding) else time


def _as_decimal(time: float) -> float:
    """A time in single precision as the shortest decimal number that is rounded to it."""
    single = np.float32(time)
    return float(str(single)) if single == time else float(time)


def _read(function: Callable[..., T], path: Path, sites: int, *arguments: object) -> T:
    """What a function reads from a trajectory. Raises OutputError for the errors of all readers."""
    if (form := BY_EXTENSION[path.suffix]).check is not None:
        try:
            read_in_process(form.check, path, 0, sites)
        except StructureError as error:
            raise OutputError(str(error)) from None
    with ignore_warnings():
        # a reader that could not open its file complains when it is deleted
        hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
        try:
            return function(path, sites, *arguments)
        except (OSError, EOFError, ValueError, TypeError, IndexError, StopIteration) as error:
            reason = " ".join(str(error).split())
        finally:
            sys.unraisablehook = hook
    raise OutputError(f"{path} cannot be read as a trajectory: {reason}")


def _frames(path: Path, sites: int, frame_limit: int) -> Frames:
    with contextlib.closing(_opened(path, sites)) as reader:
        count = reader.n_frames
        stride = max(1, -(-count // frame_limit))
        selected = range(0, count, stride)
        times, boxes = [], []
        positions = np.empty((len(selected), sites, 3), np.float32)
        velocities = np.empty_like(positions) if count and reader.ts.has_velocities else None
        for n, frame in enumerate(_whole_frames(reader, path, selected)):
            times.append(frame.time)
            positions[n] = frame.positions
            boxes.append(None if frame.dimensions is None else frame.triclinic_dimensions)
            if velocities is not None:
                velocities[n] = frame.velocities
    if not times:
        raise OutputError(f"{path} holds no whole frame")
    is_cut = len(times) < len(selected)
    text_times, text_cells = _times_and_cells_in_text(path)
    if text_times:
        times = text_times[::stride][: len(times)]
    cells = np.array(boxes) if all(box is not None for box in boxes) else None
    if text_cells:
        cells = np.array(text_cells[::stride][: len(times)])
    moving = None if velocities is None else velocities[: len(times)]
    return Frames(np.array(times), positions[: len(times)], cells, count, stride, is_cut, moving)


def _times(path: Path, sites: int) -> list[float]:
    with contextlib.closing(_opened(path, sites)) as reader:
        times = [frame.time for frame in _whole_frames(reader, path, range(reader.n_frames))]
    text_times, _ = _times_and_cells_in_text(path)
    return text_times[: len(times)] if text_times else times


def _opened(path: Path, sites: int) -> TrajectoryReader:
    """The reader of a trajectory. Raises OutputError if it has another number of sites."""
    reader = cast(TrajectoryReader, reader_of(path.suffix)(str(path)))
    if reader.n_atoms != sites:
        reader.close()
        raise OutputError(
            f"{path} is not the trajectory of this run: {reader.n_atoms} sites, must be {sites}"
        )
    return reader


def _whole_frames(reader: TrajectoryReader, path: Path, selected: range) -> Iterator[Timestep]:
    """The selected frames of a reader, without an incomplete last one. Raises OutputError for any
    other."""
    for k in selected:
        try:
            frame = reader[k]
        except (OSError, EOFError, ValueError):
            if k + selected.step < reader.n_frames:
                problem = f"frame {k + 1} of {reader.n_frames} is not one of {reader.n_atoms} sites"
                raise OutputError(f"{path}: {problem}") from None
            return
        yield frame


def _times_and_cells_in_text(path: Path) -> tuple[list[float], list[np.ndarray]]:
    """Times (ps) and cells (3, 3) in lines between the frames of a text, which MDAnalysis
    ignores."""
    times = []
    cells = []
    pattern = BY_EXTENSION[path.suffix].times
    if pattern is None:
        return times, cells
    with path.open("rb") as file:
        for line in file:
            if (b"Time=" in line or line.startswith(b"REMARK")) and (
                match := re.search(pattern, line)
            ):
                times.append(float(match[2]))
                if match[1]:
                    cells.append(np.array(match[1].split(), float).reshape(3, 3))
    return times, cells


def read_exactly(path: Path) -> list[Frame]:
    """All frames as the reader of their format in rigidmd has them. Raises OutputError if they
    cannot be read."""
    try:
        with contextlib.closing(not_none(BY_EXTENSION[path.suffix].reader)(path)) as reader:
            return [reader.frame(k) for k in range(reader.count)]
    except (OSError, ValueError) as error:
        raise OutputError(f"{path} cannot be read: {error}") from None


def near_pairs(
    at: np.ndarray, cell: np.ndarray | None, distance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (p, 2) of points (k, 3) closer than `distance`, in a cell (3, 3) or without a box, and
    the vectors (p, 3) from the first to the second. Å, single precision."""
    box = None if cell is None else np.array(dimensions(cell), np.float32)
    pairs = self_capped_distance(at.astype(np.float32), distance, box=box, return_distances=False)
    vectors = (at[pairs[:, 1]] - at[pairs[:, 0]]).astype(np.float32)
    return pairs, vectors if box is None else minimize_vectors(vectors, box)


class SiteReader(ReaderBase):
    """MDAnalysis' reader of the formats with a reader of rigidmd."""

    units = {"time": "ps", "length": "Angstrom", "velocity": "Angstrom/ps"}  # noqa: RUF012  (MDAnalysis has it so)

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
        path = Path(str(self.filename))
        self._file = not_none(BY_EXTENSION[path.suffix].reader)(path)
        self.n_atoms, self._frame = self._file.sites, -1

    def close(self):
        if hasattr(self, "_file"):
            self._file.close()

    def _read_frame(self, i):
        if not 0 <= i < self.n_frames:
            raise OSError(f"frame {i} does not exist")
        stored = self._file.frame(i)
        if len(stored.positions) != self.n_atoms:
            raise ValueError(f"frame {i + 1} has another number of sites")
        self._frame = self.ts.frame = i
        set_frame(self.ts, stored)
        return self.ts

    def _read_next_timestep(self, ts=None):
        return self._read_frame(self._frame + 1)


class _WithTimes(ProtoReader):
    """Mixin for a reader that returns the times of the run (ps), evenly spaced or not, instead of
    those in the file."""

    def __init__(self, *source, times: list[float], **options):
        self._times = times
        self._dt = float(times[1] - times[0]) if len(times) > 1 else 0.0
        # a reader passes its options to its copies
        super().__init__(*source, **options | {"times": times})
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


class _WithoutOffsetsFile:
    """Mixin for the readers of XTC and TRR. Offsets of frames stay in memory: no file is made next
    to a trajectory, and none there is believed."""

    def _load_offsets(self):
        self._read_offsets()

    def _read_offsets(self, store=False):
        super()._read_offsets(store=False)  # pyright: ignore[reportAttributeAccessIssue]


def reader_of(extension: str) -> type[ReaderBase]:
    """MDAnalysis' class of readers of a format."""
    form = BY_EXTENSION[extension]
    if form.reader:
        reader = SiteReader
    else:
        found = get_reader_for(f"x{extension}", form.mdanalysis or extension[1:])
        reader = cast(type[ReaderBase], found)
    return _subclass(_WithoutOffsetsFile, reader) if issubclass(reader, XDRBaseReader) else reader


def timed(reader: type[Reader]) -> type[Reader]:
    """A subclass of a reader with the times of the run."""
    return _subclass(_WithTimes, reader)


@functools.cache
def _subclass(mixin: type, reader: type[Reader]) -> type[Reader]:
    """A subclass of a reader with a mixin, as a name of this module, so that it can be pickled."""
    name = f"{reader.__name__}{mixin.__name__}"
    globals()[name] = type(reader)(name, (mixin, reader), {"__module__": __name__})
    return globals()[name]
