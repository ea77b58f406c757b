"""Binary trajectories without names of atoms: XTC and TRR of GROMACS, DCD of CHARMM and NAMD, NetCDF of AMBER.

MDAnalysis writes and reads them. XTC has positions to 0.001 nm, TRR and NetCDF velocities too. DCD stores one time
between all frames.
"""

import contextlib
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from rigidmd.io.formats import Encode, Format, System, register
from rigidmd.io.formats.atoms import Frame
from rigidmd.io.formats.through_mdanalysis import FrameFiles, index_of, scratch_file

NM_PER_A, PER_NM, NM = 0.1, 1000.0, 10.0  # the last in Å


def step_in_32_bits(step: int) -> int:
    """As in GROMACS, which has 32 bits of the step."""
    return (step + 2**31) % 2**32 - 2**31


def xtc_encoder(system: System, interval: float, velocities: bool) -> Encode:
    """The same bytes as from MDAnalysis' writer, in half the time."""
    from MDAnalysis.lib.formats.libmdaxdr import XTCFile

    def encode(frame: Frame, k: int) -> bytes:
        positions = frame.positions.astype(np.float32)
        positions *= NM_PER_A
        box = np.zeros((3, 3)) if frame.cell is None else NM_PER_A * frame.cell
        with scratch_file() as path:
            with XTCFile(path, "w") as file:
                file.write(positions, box.astype(np.float32), step_in_32_bits(frame.step), frame.time, PER_NM)
            return Path(path).read_bytes()

    return encode


def trr_encoder(system: System, interval: float, velocities: bool) -> Encode:
    files = FrameFiles(system, velocities, "TRR")
    return lambda frame, k: files.content(frame._replace(step=step_in_32_bits(frame.step)))


def dcd_encoder(system: System, interval: float, velocities: bool) -> Encode:
    files = FrameFiles(system, velocities, "DCD", {"dt": interval})
    size = 80 + 12 * files.sites
    return lambda frame, k: files.content(frame)[0 if k == 0 else -size :]


def netcdf_encoder(system: System, interval: float, velocities: bool) -> Encode:
    files = FrameFiles(system, velocities, "NCDF", {"velocities": velocities})
    size = 4 + 12 * files.sites * (1 + velocities)
    return lambda frame, k: files.content(frame)[0 if k == 0 else -size - 48 * (frame.cell is not None) :]


def count_frames(path: str, frame: int, atoms: int) -> dict[str, np.ndarray]:
    """The number of readable frames of .xtc."""
    from MDAnalysis.lib.formats.libmdaxdr import XTCFile

    count = 0
    with XTCFile(path) as file, contextlib.suppress(OSError):  # the file ends within a frame
        for _ in file:
            count += 1
    return {"count": np.array(count)}


def arrays_of_xdr(name: str, path: str, frame: int, atoms: int) -> dict[str, np.ndarray]:
    """A frame of .xtc or .trr, by the library of MDAnalysis' readers, which themselves write files with offsets."""
    library = import_module("MDAnalysis.lib.formats.libmdaxdr")
    with getattr(library, name)(path) as file:
        _check(file.n_atoms, atoms)
        file.seek(k := index_of(len(file), frame))
        found = file.read()
        if not getattr(found, "hasx", True):
            raise ValueError(f"frame {k + 1} has no positions")
        arrays = {"position": found.x * NM}
        if getattr(found, "hasv", False):
            arrays["velocity"] = found.v * NM
        if found.box.any():
            arrays["cell"] = found.box * NM
    return arrays


def arrays_of_reader(name: str, path: str, frame: int, atoms: int) -> dict[str, np.ndarray]:
    """A frame by the reader of MDAnalysis for the format of this name."""
    from MDAnalysis.coordinates.core import get_reader_for

    reader_class: Any = get_reader_for(path, name)
    with reader_class(path) as reader:
        _check(reader.n_atoms, atoms)
        found = reader[index_of(reader.n_frames, frame)]
        arrays = {"position": found.positions}
        if found.has_velocities:
            arrays["velocity"] = found.velocities
        if found.dimensions is not None:
            arrays["cell"] = found.triclinic_dimensions
    return arrays


def _check(there: int, wanted: int) -> None:
    if there != wanted:
        raise ValueError(f"it has {there} atoms, the file with their names {wanted}")


register(Format(
    (".xtc",), read_arrays=partial(arrays_of_xdr, "XTCFile"), encoder=xtc_encoder, check=count_frames,
    limits=(-2e7, 2e7),  # coordinates are 32-bit integers
))  # fmt: skip
register(Format((".trr",), read_arrays=partial(arrays_of_xdr, "TRRFile"), encoder=trr_encoder, velocities=True))
register(Format(
    (".dcd",), read_arrays=partial(arrays_of_reader, "DCD"), encoder=dcd_encoder, counter=(8, "<i"), even=True,
))  # fmt: skip
register(Format(
    (".nc", ".ncdf"), read_arrays=partial(arrays_of_reader, "NCDF"), mdanalysis="NCDF", encoder=netcdf_encoder,
    counter=(4, ">i"), velocities=True,
))  # fmt: skip
