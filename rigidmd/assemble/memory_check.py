"""Compares the memory that a scene needs with the free memory, before any of it is used.

NumPy's arrays of zeros take no memory before they are written, so the arrays of an engine can be
made and added up.
"""

from math import prod
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.core.process import format_gigabytes, free_memory, memory_shortage
from rigidmd.core.state import no_load
from rigidmd.errors import SceneError

if TYPE_CHECKING:
    from rigidmd.engines.system import System
    from rigidmd.scene import MolecularScene

#: Bytes per molecule and site of a system while it is built; measured per site: 310 of argon, 500
#: of nitrogen, 640 of SPC/E, 690 of TIP4P.
BYTES_PER_MOLECULE, BYTES_PER_SITE = 200, 130
#: Bytes per site if a trajectory is written, mostly by MDAnalysis; measured: 430 of SPC/E.
BYTES_PER_TRAJECTORY_SITE = 430
#: Bytes per line of log.csv, which the run keeps as numbers (measured: 300 while it runs, 870 in
#: the summary), and per frame of a file, whose time is kept.
BYTES_PER_LOG_LINE, BYTES_PER_FRAME = 870, 150
ADVICE = "take fewer molecules, a smaller box or a shorter cutoff"


def require_memory(source: str, needed: float, what: str, advice: str) -> None:
    """Raise SceneError if a number of bytes exceeds the free memory."""
    if error := memory_shortage(needed, what):
        raise SceneError(source, [f"not enough memory: {error}: {advice}"])


def check_memory_of_molecules(source: str, molecules: int, sites: int) -> None:
    """Raise SceneError if these numbers of molecules and of all their sites exceed the memory."""
    needed = BYTES_PER_MOLECULE * molecules + BYTES_PER_SITE * sites
    require_memory(
        source,
        needed,
        f"a system of {molecules} molecules with {sites} sites",
        "take fewer molecules",
    )


def check_memory(system: "System") -> None:
    """Raise SceneError if a run of a system exceeds the memory: states, forces, lists, grids,
    samples."""
    source = system.scene.source
    try:
        needed = bytes_of(system)
    except MemoryError as error:  # of NumPy, with the shape of the array
        shape = getattr(error, "shape", ())
        dtype = getattr(error, "dtype", np.uint8)
        needed = max(prod(shape) * np.dtype(dtype).itemsize, int(free_memory()))
        free = format_gigabytes(free_memory())
        fault = (
            f"a single array of it needs {format_gigabytes(needed)}, and this machine has {free}"
            " free"
        )
        raise SceneError(source, [f"not enough memory: {fault}: {ADVICE}"]) from None
    lines, samples = _samples(system.scene)
    longer = "lengthen output.log_interval_ps and output.trajectory_interval_ps"
    require_memory(source, samples, f"a run with {lines:.3g} lines in its log", longer)
    require_memory(source, needed, "the run", ADVICE)


def _samples(scene: "MolecularScene") -> tuple[float, float]:
    """Number of log lines in a run, and the bytes that these lines and the frame times have at its
    end."""
    output = scene.output
    lines, frames = (  # at the interval and at the ends of stages
        sum(2 + s.duration / (every if s.is_auto else max(every, s.step)) for s in scene.stages)
        for every in (output.log_interval_ps, output.trajectory_interval_ps)
    )
    return lines, BYTES_PER_LOG_LINE * lines + BYTES_PER_FRAME * (
        frames if output.trajectory else 0
    )


def bytes_of(system: "System") -> int:
    """Bytes of a run: three states (start, present, last good one), two loads (of steps and
    observations), samples."""
    state = system.state
    trajectory = (
        BYTES_PER_TRAJECTORY_SITE * system.site_count if system.scene.output.trajectory else 0
    )
    arrays = 3 * array_bytes(state) + 2 * array_bytes(no_load(state))
    arrays += array_bytes((system.engine().new_workspaces(state), system.model))
    return arrays + trajectory + round(_samples(system.scene)[1])


def array_bytes(value: tuple) -> int:
    """Bytes of all arrays in nested tuples. Memory that several arrays use counts once."""
    sizes = {}
    pending = [value]
    while pending:
        part = pending.pop()
        if isinstance(part, tuple):
            pending += part
        elif isinstance(part, np.ndarray):
            while isinstance(part.base, np.ndarray):  # the array whose memory it uses
                part = part.base
            sizes[id(part)] = part.nbytes
    return sum(sizes.values())
