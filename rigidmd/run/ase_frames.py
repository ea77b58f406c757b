"""Frames of a run of molecules as `ase.Atoms`."""

import contextlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rigidmd.core.process import ignore_warnings
from rigidmd.core.state import NOW
from rigidmd.engines.system import System
from rigidmd.io.formats import format_of
from rigidmd.io.formats.through_ase import EV, atoms_of_sites, atoms_of_system
from rigidmd.io.trajectory import read_exactly
from rigidmd.run.atom_forces import ase_results
from rigidmd.units import KJ_PER_MOL

if TYPE_CHECKING:
    import ase

    from rigidmd.run.results import Results

#: Times of a run that differ by less than this fraction are equal.
SAME_TIME = 1e-9


def atoms_of_results(results: "Results", frame: int | slice | str | None) -> "ase.Atoms | list[ase.Atoms]":
    """See `Results.atoms`."""
    system = results.system
    if not isinstance(system, System):
        raise ValueError("this is a run of a single body, which has no atoms")
    if frame is None:
        return _final(results, system)
    count = len(results._frames)
    if count == 0:
        raise ValueError("this run has no frames (output.trajectory = false); atoms() is the final state")
    indices = _frame_indices(frame, count)
    read = _reader(results, system)
    at_end = _same(results._frames[-1].time, float(results.state.time[NOW]))
    found = [_final(results, system) if at_end and k == count - 1 else read(k) for k in indices]
    return found if isinstance(indices, range) else found[0]


def _frame_indices(frame: int | slice | str, count: int) -> range | list[int]:
    """Indices of frames: a range for several, a list of one for an index. Raises IndexError, ValueError."""
    wanted: Any = frame
    if isinstance(frame, str):
        with contextlib.suppress(ValueError):
            parts = [int(part) if part.strip() else None for part in frame.split(":")]
            wanted = parts[0] if len(parts) == 1 else slice(*parts) if len(parts) < 4 else frame
    if isinstance(wanted, slice) and wanted.step != 0:
        return range(count)[wanted]
    if not isinstance(wanted, int | np.integer):
        raise ValueError(f"frame is {frame!r}, must be a number, a slice or a text like '-1' or '::10'")
    if not -count <= wanted < count:
        raise IndexError(f"frame {wanted} is out of range: this run has {count}")
    return [int(wanted) % count]


def _final(results: "Results", system: System) -> "ase.Atoms":
    """The final state, exactly, with its energy, forces and stress."""
    from ase.calculators.singlepoint import SinglePointCalculator

    found = atoms_of_system(system, results.state, _wrapped(system))
    found.info["time_ps"] = float(results.state.time[NOW])
    found.calc = SinglePointCalculator(found, **ase_results(system, system.engine(), results.state))
    return found


def _reader(results: "Results", system: System) -> Callable[[int], "ase.Atoms"]:
    from ase.calculators.singlepoint import SinglePointCalculator

    frames = results._frames
    sites = (
        _from_files(results) if results.files else lambda k: (frames[k].positions, frames[k].velocities, frames[k].cell)
    )
    times, energies = results["time"], results["potential"]

    def read(k: int) -> "ase.Atoms":
        time = frames[k].time
        positions, velocities, cell = sites(k)
        found = atoms_of_sites(system, positions, velocities, cell, time)
        if len(same := np.flatnonzero(_same(times, time))):
            energy = energies[same[-1]] * KJ_PER_MOL / EV  # after a minimisation that begins then
            found.calc = SinglePointCalculator(found, energy=float(energy))
        return found

    return read


def _from_files(results: "Results") -> Callable[[int], tuple]:
    """A function that reads positions, velocities and cell of frame k from the files."""
    for path in results.files:
        if (form := format_of(path)) is not None and form.double:
            frames = read_exactly(path)
            return lambda k: frames[k].sites
    with ignore_warnings():  # frames that are not evenly spaced: each has its time
        trajectory = cast(Any, results.universe().trajectory)

    def sites(k: int) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
        frame = trajectory[k]
        cell = None if frame.dimensions is None else frame.triclinic_dimensions
        return frame.positions, frame.velocities if frame.has_velocities else None, cell

    return sites


def _wrapped(system: System) -> bool:
    return system.scene.output.positions == "wrapped"


def _same(time: Any, other: float) -> Any:
    return np.abs(time - other) <= SAME_TIME * max(abs(other), 1.0)
