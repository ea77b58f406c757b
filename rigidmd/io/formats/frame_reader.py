"""A program that reads a frame of a trajectory by MDAnalysis. Its arguments are PATH FRAME ATOMS TARGET.

It is a separate process, because the C code that reads these formats crashes on damaged files. FRAME is 1 for the first
and -1 for the last frame; 0 tries all frames of an .xtc. ATOMS is the required number of atoms. TARGET is the .npz file
of the results: position (n, 3) in Å, and velocity (n, 3) in Å/ps and cell (3, 3) in Å if the file has them; `count`
for FRAME 0; or `error`, a message.
"""

import sys
import warnings
from pathlib import Path

import numpy as np

NM = 10.0  # Å


def read(path: str, frame: int, atoms: int) -> dict[str, np.ndarray]:
    """The arrays of a frame. Raises the exceptions of the readers."""
    if frame == 0:
        return _tried(path)
    return {".xtc": _gromacs, ".trr": _gromacs}.get(Path(path).suffix.lower(), _others)(path, frame, atoms)


def _gromacs(path: str, frame: int, atoms: int) -> dict[str, np.ndarray]:
    """XTC and TRR, by the library of MDAnalysis' readers, which themselves write files with offsets."""
    from MDAnalysis.lib.formats.libmdaxdr import TRRFile, XTCFile

    with (XTCFile if path.lower().endswith(".xtc") else TRRFile)(path) as file:
        _check(file.n_atoms, atoms)
        file.seek(k := _index(len(file), frame))
        found = file.read()
        if not getattr(found, "hasx", True):
            raise ValueError(f"frame {k + 1} has no positions")
        arrays = {"position": found.x * NM}
        if getattr(found, "hasv", False):
            arrays["velocity"] = found.v * NM
        if found.box.any():
            arrays["cell"] = found.box * NM
    return arrays


def _tried(path: str) -> dict[str, np.ndarray]:
    """The number of readable frames of an .xtc."""
    from MDAnalysis.lib.formats.libmdaxdr import XTCFile

    count = 0
    with XTCFile(path) as file:
        try:
            for _ in file:
                count += 1
        except OSError:  # the file ends within a frame
            pass
    return {"count": np.array(count)}


def _others(path: str, frame: int, atoms: int) -> dict[str, np.ndarray]:
    """DCD and AMBER's NetCDF."""
    from MDAnalysis.coordinates.DCD import DCDReader
    from MDAnalysis.coordinates.TRJ import NCDFReader

    with (DCDReader if path.lower().endswith(".dcd") else NCDFReader)(path) as reader:
        _check(reader.n_atoms, atoms)
        found = reader[_index(reader.n_frames, frame)]
        arrays = {"position": found.positions}
        if found.has_velocities:
            arrays["velocity"] = found.velocities
        if found.dimensions is not None:
            arrays["cell"] = found.triclinic_dimensions
    return arrays


def _check(there: int, wanted: int) -> None:
    if there != wanted:
        raise ValueError(f"it has {there} atoms, the file with their names {wanted}")


def _index(count: int, frame: int) -> int:
    if not 1 <= abs(frame) <= count:
        raise ValueError(f"structure.frame is {frame}: it holds {count}, 1 is the first and -1 the last")
    return frame - 1 if frame > 0 else count + frame


def main(path: str, frame: str, atoms: str, target: str) -> None:
    warnings.simplefilter("ignore")
    try:
        found = {name: values.astype(float) for name, values in read(path, int(frame), int(atoms)).items()}
    except Exception as error:  # many types, from OSError to MemoryError
        found = {"error": np.array(" ".join(str(error).split()) or type(error).__name__)}
    np.savez(target, **found)  # pyright: ignore[reportArgumentType]


if __name__ == "__main__":
    main(*sys.argv[1:])
