"""Compares the memory that a scene needs with the free memory, before any of it is used.

NumPy's arrays of zeros take no memory before they are written, so the arrays of an engine can be made and added up.
"""

from collections.abc import Iterator
from math import prod
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.core.process import format_gigabytes, free_memory, memory_shortage
from rigidmd.core.state import no_load
from rigidmd.errors import SceneError
from rigidmd.scene import BodyScene
from rigidmd.scene.validation import not_none
from rigidmd.units import FEMTOSECOND

if TYPE_CHECKING:
    from rigidmd.engines.system import System

#: Bytes per molecule and site of a system while it is built; measured per site: 310 of argon, 500 of nitrogen, 640 of
#: SPC/E, 690 of TIP4P.
BYTES_PER_MOLECULE, BYTES_PER_SITE = 200, 130
#: Bytes per site if a trajectory is written, mostly by MDAnalysis; measured: 430 of SPC/E.
BYTES_PER_TRAJECTORY_SITE = 430
#: Bytes per sample of a body; measured: a snapshot of its state 1.9 kB, its columns at the end 0.85 kB.
BYTES_PER_SAMPLE = 2700
#: Bytes per line of log.csv, which the run keeps as numbers (measured: 300 while it runs, 870 in the summary), and per
#: frame of a file, whose time is kept.
BYTES_PER_LOG_LINE, BYTES_PER_FRAME = 870, 150
ADVICE = "take fewer molecules, a smaller box or a shorter cutoff"


def _require(source: str, needed: float, what: str, advice: str) -> None:
    """Raise SceneError if a number of bytes exceeds the free memory."""
    if fault := memory_shortage(needed, what):
        raise SceneError(source, [f"not enough memory: {fault}: {advice}"])


def check_memory_of_molecules(source: str, molecules: int, sites: int) -> None:
    """Raise SceneError if these numbers of molecules and of all their sites exceed the memory."""
    needed = BYTES_PER_MOLECULE * molecules + BYTES_PER_SITE * sites
    _require(source, needed, f"a system of {molecules} molecules with {sites} sites", "take fewer molecules")


def check_memory_of_samples(scene: BodyScene) -> None:
    """Raise SceneError if the samples of a resolved scene of a body exceed the memory."""
    run, interval = scene.run, not_none(scene.output.interval_s)
    samples = run.duration_s / (interval if run.is_auto else max(interval, run.timestep_s))
    _require(
        scene.source, BYTES_PER_SAMPLE * samples, f"a run with {samples:.3g} samples", "lengthen output.interval_s"
    )


def check_memory(system: "System") -> None:
    """Raise SceneError if a run of a system exceeds the memory: states, forces, lists, grids, samples."""
    source, output = system.scene.source, system.scene.output
    try:
        needed = bytes_of(system)
    except MemoryError as error:  # of NumPy, with the shape of the array
        shape, dtype = getattr(error, "shape", ()), getattr(error, "dtype", np.uint8)
        needed = max(prod(shape) * np.dtype(dtype).itemsize, int(free_memory()))
        free = format_gigabytes(free_memory())
        fault = f"a single array of it needs {format_gigabytes(needed)}, and this machine has {free} free"
        raise SceneError(source, [f"not enough memory: {fault}: {ADVICE}"]) from None
    lines = f"a run with {observation_count(system, output.log_interval_ps):.3g} lines in its log"
    longer = "lengthen output.log_interval_ps and output.trajectory_interval_ps"
    _require(source, bytes_of_samples(system), lines, longer)
    _require(source, needed, "the run", ADVICE)


def observation_count(system: "System", interval: float) -> float:
    """Number of observations of a run at an interval (ps) and at the ends of its stages."""
    return sum(
        2 + stage.duration / (interval if stage.is_auto else max(interval, stage.timestep_fs * FEMTOSECOND))
        for stage in system.scene.stages
    )


def bytes_of_samples(system: "System") -> float:
    """Bytes of the lines of the log and the times of frames at the end of a run."""
    output = system.scene.output
    frames = observation_count(system, output.trajectory_interval_ps) if output.trajectory else 0
    return BYTES_PER_LOG_LINE * observation_count(system, output.log_interval_ps) + BYTES_PER_FRAME * frames


def bytes_of(system: "System") -> int:
    """Bytes of a run: three states (start, present, last good one), two loads (of steps and observations), samples."""
    state = system.state
    trajectory = BYTES_PER_TRAJECTORY_SITE * system.site_count if system.scene.output.trajectory else 0
    arrays = 3 * array_bytes(state) + 2 * array_bytes(no_load(state))
    arrays += array_bytes((system.engine().new_workspaces(state), system.model))
    return arrays + trajectory + round(bytes_of_samples(system))


def array_bytes(value: tuple) -> int:
    """Bytes of all arrays in nested tuples. Memory that several arrays use counts once."""
    return sum({id(owner): owner.nbytes for owner in map(_owner, _arrays(value))}.values())


def _owner(array: np.ndarray) -> np.ndarray:
    """The array whose memory an array uses."""
    while isinstance(array.base, np.ndarray):
        array = array.base
    return array


def _arrays(value) -> Iterator[np.ndarray]:
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, tuple):
        for part in value:
            yield from _arrays(part)
