"""Frames in the formats of MDAnalysis: the file of one frame by its writers, and reading in another process."""

import contextlib
import os
import pickle
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from rigidmd.core.process import ignore_warnings
from rigidmd.core.state import edges_and_angles
from rigidmd.io.formats import System
from rigidmd.io.formats.atoms import Frame, structure_error


def dimensions(cell: np.ndarray | None) -> list[float] | None:
    """A cell (3, 3) in MDAnalysis' form; None without a box."""
    return None if cell is None or cell[0, 0] == inf else edges_and_angles(cell)


def universe_of(system: System, velocities: bool = False) -> Any:
    """An MDAnalysis Universe of all sites, one residue per molecule, without bonds."""
    import MDAnalysis as mda

    sites, names = system.sites, system.residue_names
    u = mda.Universe.empty(
        len(sites.molecule), n_residues=len(names), atom_resindex=sites.molecule, trajectory=True, velocities=velocities
    )
    attributes = {"names": sites.name, "types": sites.element, "elements": sites.element, "masses": sites.mass}
    for name, values in (attributes | {"resnames": names, "resids": np.arange(1, len(names) + 1)}).items():
        u.add_TopologyAttr(name, values)
    return u


def set_frame(timestep: Any, frame: Frame) -> None:
    timestep.positions = frame.positions
    if frame.velocities is not None:
        timestep.velocities = frame.velocities
    timestep.dimensions = dimensions(frame.cell)
    timestep.time, timestep.data["step"] = frame.time, frame.step


class FrameFiles:
    """Makes the content of a file with one frame, which MDAnalysis writes in memory, with `options` of its writer."""

    def __init__(self, system: System, velocities: bool, name: str, options: dict[str, Any] | None = None):
        self._universe, self._name, self._options = universe_of(system, velocities), name, options or {}
        self.sites: int = len(system.sites.name)

    def content(self, frame: Frame, write: Callable[[Any, Any], object] | None = None, **options: Any) -> bytes:
        """`write(writer, atoms)` is called in place of `writer.write(atoms)`."""
        import MDAnalysis as mda

        set_frame(self._universe.trajectory.ts, frame)
        with scratch_file() as path, ignore_warnings():
            writer: Any = mda.Writer(path, n_atoms=self.sites, format=self._name, **self._options, **options)
            with writer:
                writer.write(self._universe.atoms) if write is None else write(writer, self._universe.atoms)
            return Path(path).read_bytes()


@contextlib.contextmanager
def scratch_file() -> Iterator[str]:
    """A path for the file of a frame: in memory on Linux, elsewhere in a temporary folder."""
    if hasattr(os, "memfd_create"):
        handle = os.memfd_create("frame")
        try:
            yield f"/proc/self/fd/{handle}"
        finally:
            os.close(handle)
    else:
        with tempfile.TemporaryDirectory() as folder:
            yield str(Path(folder) / "frame")


#: The arguments of Python that run `main`.
PROGRAM = ("-c", f"from {__name__} import main; main()")


def read_in_process(
    read: Callable[[str, int, int], dict[str, np.ndarray]], path: Path, frame: int, atoms: int
) -> dict[str, np.ndarray]:
    """The arrays that `read(path, frame, atoms)` returns, which can be pickled. Raises StructureError."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "frame.npz"
        arguments = [pickle.dumps(read).hex(), str(path), str(frame), str(atoms), str(target)]
        ended = subprocess.run(
            [sys.executable, "-P", *PROGRAM, *arguments], stdin=subprocess.DEVNULL, capture_output=True, check=False,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )  # fmt: skip
        if ended.returncode < 0 or not target.is_file():
            reason = "its reader crashed" if ended.returncode < 0 else ended.stderr.decode(errors="replace")[-300:]
            raise structure_error(path, f"cannot be read as a trajectory: {reason}. Is it damaged?")
        with np.load(target, allow_pickle=False) as data:
            found = dict(data)
    if "error" in found:
        raise structure_error(path, f"cannot be read as a trajectory: {found['error']}")
    return found


def main() -> None:
    """The program of the process: its arguments are a pickled function, its arguments, and the file for the arrays, or
    for `error`, a message."""
    read, path, frame, atoms, target = sys.argv[1:]
    warnings.simplefilter("ignore")
    try:
        arrays = pickle.loads(bytes.fromhex(read))(path, int(frame), int(atoms))
        found = {name: values.astype(float) for name, values in arrays.items()}
    except Exception as error:  # many types, from OSError to MemoryError
        found = {"error": np.array(" ".join(str(error).split()) or type(error).__name__)}
    np.savez(target, **found)  # pyright: ignore[reportArgumentType]


def index_of(count: int, frame: int) -> int:
    """The index of a frame of `count`: 1 is the first and -1 the last. Raises ValueError."""
    if not 1 <= abs(frame) <= count:
        raise ValueError(f"structure.frame is {frame}: it holds {count}, 1 is the first and -1 the last")
    return frame - 1 if frame > 0 else count + frame
