"""A frame of a trajectory as the atoms of a structure, read through MDAnalysis, a .gsd by its library."""

import contextlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rigidmd.io.atoms import Atoms, structure_error
from rigidmd.io.formats.gsd import GsdReader

#: The program that reads a frame.
PROGRAM = Path(__file__).with_name("frame_reader.py")


def read_trajectory(path: Path, frame: int | None, named: Callable[[], Atoms] | None) -> Atoms:
    """The atoms of a frame: 1 for the first, -1 or None for the last. `named` returns the atoms of the topology file,
    for their names; None for a .gsd, which has names. Raises StructureError."""
    frame = -1 if frame is None else frame
    if named is None:
        return _read_gsd(path, frame)
    atoms = named()
    found = read_in_process(path, frame, len(atoms.names))
    return atoms._replace(position=found["position"], velocity=found.get("velocity"), cell=found.get("cell"))


def read_in_process(path: Path, frame: int, atoms: int) -> dict[str, np.ndarray]:
    """The arrays of `frame_reader`, a separate process, which a damaged file may crash. Raises StructureError."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "frame.npz"
        command = [sys.executable, "-P", str(PROGRAM), str(path), str(frame), str(atoms), str(target)]
        paths = os.pathsep.join(filter(None, sys.path))
        ended = subprocess.run(
            command, env=os.environ | {"PYTHONPATH": paths}, stdin=subprocess.DEVNULL, capture_output=True, check=False
        )
        if ended.returncode < 0 or not target.is_file():
            reason = "its reader crashed" if ended.returncode < 0 else ended.stderr.decode(errors="replace")[-300:]
            raise structure_error(path, f"cannot be read as a trajectory: {reason}. Is it damaged?")
        with np.load(target, allow_pickle=False) as data:
            found = dict(data)
    if "error" in found:
        raise structure_error(path, f"cannot be read as a trajectory: {found['error']}")
    return found


def _read_gsd(path: Path, frame: int) -> Atoms:
    try:
        with contextlib.closing(GsdReader(path)) as reader:
            if not 1 <= abs(frame) <= reader.count:
                raise structure_error(
                    path, f"structure.frame is {frame}: it holds {reader.count}, 1 is the first and -1 the last"
                )
            found = reader.read(frame - 1 if frame > 0 else reader.count + frame)
    except (OSError, ValueError) as error:
        raise structure_error(path, f"cannot be read as a trajectory: {error}") from None
    sites = found.sites
    names = [found.label[site].rsplit(".", 1)[-1] for site in sites]  # a type may be species.name
    return Atoms(
        names, [""] * len(names), [(int(owner) + 1, found.label[owner]) for owner in found.owner[sites]],
        found.position[sites], found.site_velocities(), found.cell, None, [],
    )  # fmt: skip
