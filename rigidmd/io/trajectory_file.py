"""Trajectories and topologies of runs, written to files of any format."""

import struct
from collections.abc import Callable, Sequence
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from rigidmd.core.files import AppendedFile, write_text, writing
from rigidmd.core.state import State
from rigidmd.errors import SimulationError
from rigidmd.formats import BY_EXTENSION, Format, Topology, written
from rigidmd.formats.atoms import Frame
from rigidmd.formats.frame_file import FrameFile
from rigidmd.scene.validation import not_none

if TYPE_CHECKING:
    from rigidmd.engines.sites import AnySystem
    from rigidmd.engines.system import System


def open_trajectory(
    path: Path,
    system: "AnySystem",
    interval: float,
    *,
    velocities: bool,
    wrapped: bool,
    kept: Sequence[int] | None = None,
) -> "TrajectoryFile | FrameFile":
    """The trajectory file for the extension of a path. For the arguments see `TrajectoryFile`."""
    if (writer := BY_EXTENSION[path.suffix].writer) is not None:
        return writer(path, cast("System", system), velocities, wrapped, kept)
    return TrajectoryFile(path, system, interval, velocities, wrapped, kept)


def write_topology(path: Path, system: "AnySystem", state: State, *, wrapped: bool) -> None:
    """Write names, molecules and first positions for viewers. Raises SimulationError if the format
    cannot hold one."""
    positions = system.site_positions(state, wrapped)
    _check_fits(
        path,
        positions,
        "output.topology",
        lambda form: form.topology and form.exceeded(positions) is None,
    )
    molecule = system.sites.molecule
    topology = Topology(
        system.sites.name.tolist(),
        system.sites.element.tolist(),
        (1 + molecule).tolist(),
        system.residue_names[molecule].tolist(),
        positions,
        state.cell if np.isfinite(state.cell).all() else None,
        system.connections,  # without massless sites, to which viewers would draw bonds
    )
    write_text(path, not_none(BY_EXTENSION[path.suffix].topology)(topology))


def _is_unlimited(form: Format) -> bool:
    """Whether a format of trajectories holds any positions at any times."""
    return bool(form.encoder) and form.limits == (-inf, inf) and not form.even


def _check_fits(
    path: Path, positions: np.ndarray, key: str, holds: Callable[[Format], object]
) -> None:
    """Raise SimulationError if the format of a file cannot hold positions (s, 3). `holds`: whether
    another format can."""
    if (bound := BY_EXTENSION[path.suffix].exceeded(positions)) is not None:
        hint = "output.positions = 'wrapped', or for a body a smaller output.trajectory_A_per_m"
        others = written(holds)
        hint = f"use {' or '.join(others)}, {hint}" if others else f"set {hint}"
        raise SimulationError(
            f"a position is beyond the {bound:g} Å that {path.suffix} ({key}) can hold: {hint}"
        )


class TrajectoryFile(AppendedFile):
    """Writes frames to a trajectory, in the format of the file's extension.

    The bytes of each frame are appended to the file. So every write is checked, a killed run leaves
    whole frames, and a resumed run can continue the file.

    interval : time between frames (ps), for formats that store it once for all frames
    kept : earlier value of the property `kept`, from which `cut` continues the file. None begins a
        new file
    Raises OutputError, here and in every method.
    """

    def __init__(
        self,
        path: Path,
        system: "AnySystem",
        interval: float,
        velocities: bool,
        wrapped: bool,
        kept: Sequence[int] | None = None,
    ):
        self._system, self._velocities, self._wrapped = system, velocities, wrapped
        form = BY_EXTENSION[path.suffix]
        self._encode = not_none(form.encoder)(system, interval, velocities)
        self._counter, self._count = form.counter[0], struct.Struct(form.counter[1])
        *before, self._frames = kept or (0, 0, 0)
        first = self._count.pack(1) if self._count.size else b""
        super().__init__(path, before if kept else None, (self._counter, first))

    @property
    def kept(self) -> tuple[int, int, int]:
        """Number of bytes, all on the disk, their checksum, and the number of frames."""
        return *super().kept, self._frames

    def write(self, state: State, time: float, step: int) -> None:
        """Add a frame with its own time (ps) and the box."""
        positions = self._system.site_positions(state, self._wrapped)
        with np.errstate(over="ignore"):  # infinite positions are beyond every limit
            rounded = positions.astype(np.float32)
        _check_fits(self._path, rounded, "output.trajectory", _is_unlimited)
        velocities = self._system.site_velocities(state) if self._velocities else None
        cell = state.cell if np.isfinite(state.cell).all() else None
        with writing(self._path):  # memory for the file of a frame may be insufficient
            piece = self._encode(Frame(time, positions, cell, velocities, step=step), self._frames)
        self.append(piece)
        self._frames += 1
        if self._count.size:
            self.patch(self._counter, self._count.pack(self._frames))
