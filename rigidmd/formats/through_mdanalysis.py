"""Frames in the formats of MDAnalysis: the file of one frame by its writers, and reading in another
process.

Its binary trajectories have no names of atoms: XTC and TRR (GROMACS), DCD (CHARMM and NAMD), NetCDF
(AMBER). XTC has positions to 0.001 nm, TRR and NetCDF velocities too. DCD stores one time between
all frames.
"""

import contextlib
import os
import pickle
import struct
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, cast

import numpy as np

from rigidmd.core.process import ignore_warnings, python_process
from rigidmd.core.state import edges_and_angles
from rigidmd.formats import Encode, Format, Placed, register
from rigidmd.formats.atoms import Frame, structure_error

if TYPE_CHECKING:
    import MDAnalysis as mda
    from MDAnalysis.coordinates.base import WriterBase
    from MDAnalysis.coordinates.timestep import Timestep


class TrajectoryReader(Protocol):
    """What is used of the readers of MDAnalysis."""

    n_atoms: int
    n_frames: int
    ts: "Timestep"

    def __getitem__(self, k: int, /) -> "Timestep": ...
    def close(self) -> object: ...


def dimensions(cell: np.ndarray | None) -> list[float] | None:
    """A cell (3, 3) in MDAnalysis' form. None without a box."""
    return None if cell is None or cell[0, 0] == inf else edges_and_angles(cell)


def universe_of(system: Placed, *, velocities: bool = False) -> "mda.Universe":
    """An MDAnalysis Universe of all sites, one residue per molecule, without bonds."""
    import MDAnalysis as mda

    sites, names = system.sites, system.residue_names
    u = mda.Universe.empty(
        len(sites.molecule),
        n_residues=len(names),
        atom_resindex=sites.molecule,
        trajectory=True,
        velocities=velocities,
    )
    attributes = {
        "names": sites.name,
        "types": sites.element,
        "elements": sites.element,
        "masses": sites.mass,
    }
    for name, values in (
        attributes | {"resnames": names, "resids": np.arange(1, len(names) + 1)}
    ).items():
        u.add_TopologyAttr(name, values)
    return u


def set_frame(timestep: "Timestep", frame: Frame) -> None:
    timestep.positions = frame.positions
    if frame.velocities is not None:
        timestep.velocities = frame.velocities
    timestep.dimensions = dimensions(frame.cell)
    timestep.time, timestep.data["step"] = frame.time, frame.step


class FrameFiles:
    """Makes the content of a file with one frame, which MDAnalysis writes in memory, with `options`
    of its writer."""

    def __init__(
        self,
        system: Placed,
        *,
        velocities: bool,
        name: str,
        options: dict[str, object] | None = None,
    ):
        self._universe = universe_of(system, velocities=velocities)
        self._name = name
        self._options = options or {}
        self.sites: int = len(system.sites.name)

    def content(
        self,
        frame: Frame,
        write: "Callable[[WriterBase, mda.AtomGroup], object] | None" = None,
        **options: object,
    ) -> bytes:
        """`write(writer, atoms)` is called in place of `writer.write(atoms)`."""
        import MDAnalysis as mda

        set_frame(self._universe.trajectory.ts, frame)
        atoms = cast("mda.AtomGroup", self._universe.atoms)
        with scratch_file() as path, ignore_warnings():
            writer = mda.Writer(
                path, n_atoms=self.sites, format=self._name, **self._options, **options
            )
            with writer:
                writer.write(atoms) if write is None else write(writer, atoms)
            return Path(path).read_bytes()


@contextlib.contextmanager
def scratch_file() -> Iterator[str]:
    """A path for the file of a frame: in memory on Linux, elsewhere in a temporary folder."""
    if sys.platform == "linux":
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
    """The arrays that `read(path, frame, atoms)` returns, which can be pickled. Raises
    StructureError."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "frame.npz"
        arguments = [pickle.dumps(read).hex(), str(path), str(frame), str(atoms), str(target)]
        ended = subprocess.run(
            **python_process(*PROGRAM, *arguments),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            check=False,
        )
        if ended.returncode < 0 or not target.is_file():
            if ended.returncode < 0:
                reason = "its reader crashed"
            else:
                reason = ended.stderr.decode(errors="replace")[-300:]
            raise structure_error(path, f"cannot be read as a trajectory: {reason}. Is it damaged?")
        with np.load(target, allow_pickle=False) as data:
            arrays = dict(data)
    if "error" in arrays:
        raise structure_error(path, f"cannot be read as a trajectory: {arrays['error']}")
    return arrays


def main() -> None:
    """The program of the process: a pickled function, its arguments, the file for the arrays or the
    message `error`."""
    read, path, frame, atoms, target = sys.argv[1:]
    warnings.simplefilter("ignore")
    try:
        arrays = pickle.loads(bytes.fromhex(read))(path, int(frame), int(atoms))
        contents = {name: values.astype(float) for name, values in arrays.items()}
    except Exception as error:  # many types, from OSError to MemoryError
        contents = {"error": np.array(" ".join(str(error).split()) or type(error).__name__)}
    np.savez(target, **contents)  # pyright: ignore[reportArgumentType]


def index_of(count: int, frame: int) -> int:
    """The index of a frame of `count`: 1 is the first and -1 the last. Raises ValueError."""
    if not 1 <= abs(frame) <= count:
        raise ValueError(
            f"structure.frame is {frame}: it holds {count}, 1 is the first and -1 the last"
        )
    return frame - 1 if frame > 0 else count + frame


NM_PER_A, PER_NM, NM = 0.1, 1000.0, 10.0  # the last in Å


def step_in_32_bits(step: int) -> int:
    """As in GROMACS, which has 32 bits of the step."""
    return (step + 2**31) % 2**32 - 2**31


#: The first number of a frame of an .xtc, and the largest number of sites whose coordinates it has
#: without compression.
XTC_MAGIC, MOST_PLAIN = 1995, 9


def xtc_encoder(system: Placed, interval: float, velocities: bool) -> Encode:
    """The same bytes as from MDAnalysis' writer, in half the time. For the few points of a body
    without MDAnalysis, which is slow to import."""

    def encode(frame: Frame, k: int) -> bytes:
        positions = frame.positions.astype(np.float32)
        positions *= NM_PER_A
        box = _NO_BOX if frame.cell is None else (NM_PER_A * frame.cell).astype(np.float32)
        encode_frame = _plain_xtc if len(positions) <= MOST_PLAIN else _compressed_xtc
        return encode_frame(positions, box, step_in_32_bits(frame.step), frame.time)

    return encode


_NO_BOX = np.zeros((3, 3), np.float32)


def _plain_xtc(positions: np.ndarray, box: np.ndarray, step: int, time: float) -> bytes:
    """A frame of coordinates (s, 3) in single precision, nm."""
    sites = len(positions)
    return b"".join(
        (
            struct.pack(">iiif", XTC_MAGIC, sites, step, time),
            box.astype(">f4").tobytes(),
            struct.pack(">i", sites),
            positions.astype(">f4").tobytes(),
        )
    )


def _compressed_xtc(positions: np.ndarray, box: np.ndarray, step: int, time: float) -> bytes:
    """A frame of coordinates (s, 3) rounded to 0.001 nm."""
    from MDAnalysis.lib.formats.libmdaxdr import XTCFile

    with scratch_file() as path:
        with XTCFile(path, "w") as file:
            file.write(positions, box, step, time, PER_NM)
        return Path(path).read_bytes()


def trr_encoder(system: Placed, interval: float, velocities: bool) -> Encode:
    files = FrameFiles(system, velocities=velocities, name="TRR")
    return lambda frame, k: files.content(frame._replace(step=step_in_32_bits(frame.step)))


def dcd_encoder(system: Placed, interval: float, velocities: bool) -> Encode:
    files = FrameFiles(system, velocities=velocities, name="DCD", options={"dt": interval})
    size = 80 + 12 * files.sites
    return lambda frame, k: files.content(frame)[0 if k == 0 else -size :]


def netcdf_encoder(system: Placed, interval: float, velocities: bool) -> Encode:
    files = FrameFiles(
        system, velocities=velocities, name="NCDF", options={"velocities": velocities}
    )
    size = 4 + 12 * files.sites * (1 + velocities)
    return lambda frame, k: files.content(frame)[
        0 if k == 0 else -size - 48 * (frame.cell is not None) :
    ]


def read_through(path: str, frame: int, atoms: int) -> dict[str, np.ndarray]:
    """Nothing, after all frames of an .xtc have been read."""
    from MDAnalysis.lib.formats.libmdaxdr import XTCFile

    with XTCFile(path) as file, contextlib.suppress(OSError):  # the file ends within a frame
        for _ in file:
            pass
    return {}


def arrays_of_xdr(name: str, path: str, frame: int, atoms: int) -> dict[str, np.ndarray]:
    """A frame of .xtc or .trr, by the library of MDAnalysis' readers, which themselves write files
    with offsets."""
    library = import_module("MDAnalysis.lib.formats.libmdaxdr")
    with getattr(library, name)(path) as file:
        _check(file.n_atoms, atoms)
        file.seek(k := index_of(len(file), frame))
        xdr_frame = file.read()
        if not getattr(xdr_frame, "hasx", True):
            raise ValueError(f"frame {k + 1} has no positions")
        arrays = {"position": xdr_frame.x * NM}
        if getattr(xdr_frame, "hasv", False):
            arrays["velocity"] = xdr_frame.v * NM
        if xdr_frame.box.any():
            arrays["cell"] = xdr_frame.box * NM
    return arrays


def arrays_of_reader(name: str, path: str, frame: int, atoms: int) -> dict[str, np.ndarray]:
    """A frame by the reader of MDAnalysis for the format of this name."""
    from MDAnalysis.coordinates.core import get_reader_for

    reader_class = cast("Callable[[str], TrajectoryReader]", get_reader_for(path, name))
    with contextlib.closing(reader_class(path)) as reader:
        _check(reader.n_atoms, atoms)
        timestep = reader[index_of(reader.n_frames, frame)]
        arrays = {"position": timestep.positions}
        if timestep.has_velocities:
            arrays["velocity"] = timestep.velocities
        if timestep.dimensions is not None:
            arrays["cell"] = timestep.triclinic_dimensions
    return arrays


def _check(count: int, expected: int) -> None:
    if count != expected:
        raise ValueError(f"it has {count} atoms, the file with their names {expected}")


register(
    Format(
        (".xtc",),
        read_arrays=partial(arrays_of_xdr, "XTCFile"),
        encoder=xtc_encoder,
        check=read_through,
        limits=(-2e7, 2e7),  # coordinates are 32-bit integers
    )
)
register(
    Format(
        (".trr",),
        read_arrays=partial(arrays_of_xdr, "TRRFile"),
        encoder=trr_encoder,
        velocities=True,
    )
)
register(
    Format(
        (".dcd",),
        read_arrays=partial(arrays_of_reader, "DCD"),
        encoder=dcd_encoder,
        counter=(8, "<i"),
        even=True,
    )
)
register(
    Format(
        (".nc", ".ncdf"),
        read_arrays=partial(arrays_of_reader, "NCDF"),
        mdanalysis="NCDF",
        encoder=netcdf_encoder,
        counter=(4, ">i"),
        velocities=True,
    )
)
