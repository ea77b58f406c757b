"""The atoms of a structure file of any format, read through ASE or by the readers in `io.formats`."""

import bz2
import codecs
import gzip
import lzma
import re
import tempfile
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from rigidmd.core.files import unreadable_reason
from rigidmd.core.process import format_gigabytes, memory_shortage
from rigidmd.errors import UNPRINTABLE
from rigidmd.io.atoms import HEAVY_HYDROGEN, Atoms, element_of, structure_error
from rigidmd.io.formats.arc import read_arc, read_cssr
from rigidmd.io.formats.gro import read_gro
from rigidmd.io.formats.lammps import read_data, read_dump
from rigidmd.io.formats.pdb import read_pdb
from rigidmd.io.formats.through_ase import from_ase, read_by_ase, read_xyz
from rigidmd.io.formats.trajectory_frames import read_trajectory
from rigidmd.scene.start import LAMMPS_DATA, NAMELESS, TOPOLOGY_NAMES, TRAJECTORIES

FARTHEST = 1e9  # Å, of an atom from the origin
HEAVIEST = 1e30  # u
FOR_BYTE = 20  # bytes of memory per byte of a file, for lines and words as text, and numbers
NO_VOLUME = 1e-9  # of a cell, relative to the cube of its longest edge
ASE_TRAJECTORY = ".traj"
#: Readers of text by extension. WITH_TYPES accept structure.atom_types.
READERS: dict[str, Callable[..., list[Callable[[], Atoms]]]] = {
    ".gro": read_gro, ".arc": read_arc, ".txyz": read_arc, ".cssr": read_cssr, ".pdb": read_pdb, ".ent": read_pdb,
    ".xyz": read_xyz, ".extxyz": read_xyz, **dict.fromkeys(LAMMPS_DATA, read_data),
}  # fmt: skip
WITH_TYPES = (read_xyz, read_data, read_dump)
NO_TYPES = "structure.atom_types is for formats whose atoms have types: LAMMPS' data files and dumps, .xyz"
#: The begin of files whose extension is unknown, by reader.
BEGINNINGS = (
    (re.compile(r"\s*ITEM: (TIMESTEP|UNITS|TIME)\b"), read_dump),
    (re.compile(r"^[ \t]*\d+[ \t]+atoms[ \t]*(#.*)?$", re.MULTILINE), read_data),
    (re.compile(r"^(ATOM  |HETATM).{24}( *-?\d+\.\d{3}){3}", re.MULTILINE), read_pdb),
    (re.compile(r"\s*\d+[ \t]*\n.*\n[ \t]*[A-Za-z]\w*([ \t]+-?\d*\.?\d+){3}"), read_xyz),
    (re.compile(r".*\n[ \t]*\d+[ \t]*\n.{20}( *-?\d+\.\d+){3}"), read_gro),
)
PACKED = {".gz": gzip.open, ".bz2": bz2.open, ".xz": lzma.open}
BEGINNING = 1 << 16  # characters
PIECE = 1 << 24  # bytes that are unpacked at a time


def read_atoms(
    path: Path,
    frame: int | None = None,
    atom_types: dict[str, str] | None = None,
    topology: Path | None = None,
    content: bytes | None = None,
) -> Atoms:
    """The atoms of a file, or of one of several structures in it. Raises StructureError.

    frame: 1 for the first, -1 for the last; None for the only structure of a file, or the last of a trajectory.
    atom_types: names of types, for formats with types. topology: a file with the names that a trajectory lacks.
    content: the content of the file, if it is not read from `path`, which is then only its name.
    """
    if content is None and (reason := unreadable_reason(path)):
        raise structure_error(path, reason)
    suffix = path.suffix.lower()
    if suffix in NAMELESS and topology is None:
        missing = f"there is no {' or '.join(TOPOLOGY_NAMES)} next to it"
        raise structure_error(path, f"holds no names of atoms, and {missing}: name a file by structure.topology")
    if suffix in TRAJECTORIES and topology is None and atom_types is not None:
        raise structure_error(path, NO_TYPES)
    if suffix in TRAJECTORIES:
        atoms = read_trajectory(
            path, frame, None if topology is None else partial(read_atoms, topology, None, atom_types)
        )
    else:
        size = path.stat().st_size if content is None else len(content)
        if shortage := memory_shortage(FOR_BYTE * size, f"reading its {format_gigabytes(size)}"):
            raise structure_error(path, f"not enough memory: {shortage}")
        with np.errstate(all="ignore"):  # what is not finite is refused below
            atoms = _choose(path, _frames(path, atom_types, content), frame)()
    if len(atoms.position) == 0:
        raise structure_error(path, "holds no atoms")
    for what, values in (("position", atoms.position), ("velocity", atoms.velocity), ("cell", atoms.cell)):
        if what == "velocity" and suffix not in TRAJECTORIES:
            continue  # some atoms may have none
        if values is not None and not np.isfinite(values).all():
            bad = int(np.argmin(np.isfinite(values).all(axis=1)))
            owner = "its box has an edge" if what == "cell" else f"atom {bad + 1} has a {what}"
            raise structure_error(path, f"{owner} that is not a finite number")
    if (far := np.abs(atoms.position).max()) > FARTHEST:
        raise structure_error(path, f"an atom is at {far:.3g} Å, farther than {FARTHEST:g} Å: is this the unit?")
    if atoms.masses is not None and not ((atoms.masses >= 0) & (atoms.masses < HEAVIEST)).all():
        raise structure_error(path, "an atom has a mass that is negative, too large or no number")
    for k, texts in enumerate(zip(atoms.names, atoms.elements, atoms.residue, strict=True), 1):
        if any(UNPRINTABLE.search(str(text)) for text in (*texts[:2], *texts[2])):
            raise structure_error(path, f"atom {k} has a name with control characters: {texts[0]!r}")
    return _without_placeholder(atoms)


def _without_placeholder(atoms: Atoms) -> Atoms:
    """The atoms without a cell that stands for none: a cell of no volume, or the cube of 1 Å of .pdb and .cssr."""
    if atoms.cell is None:
        return atoms
    longest = np.linalg.norm(atoms.cell, axis=1).max()
    if np.abs(np.linalg.det(atoms.cell)) <= NO_VOLUME * longest**3:
        note = ["its cell has no volume and is not used"] if longest else []
        return atoms._replace(cell=None, notes=[*atoms.notes, *note])
    if np.allclose(atoms.cell, np.eye(3), rtol=0, atol=1e-6):
        return atoms._replace(cell=None, notes=[*atoms.notes, "its cell, a cube of 1 Å, stands for none"])
    return atoms


def read_geometry(path: Path) -> tuple[list[str], list[str], np.ndarray, np.ndarray]:
    """Names, elements, masses (s,) and positions (s, 3) of the atoms of a file with one molecule."""
    from ase.data import atomic_masses, atomic_numbers

    def mass(element: str) -> float:
        return HEAVY_HYDROGEN[element] if element in HEAVY_HYDROGEN else float(atomic_masses[atomic_numbers[element]])

    if path.suffix.lower() in TRAJECTORIES:
        raise structure_error(path, "is a trajectory: name a structure file, or write a frame of it as one")
    atoms = read_atoms(path)
    elements = [e or element_of(name) or "X" for e, name in zip(atoms.elements, atoms.names, strict=True)]
    masses = np.array([mass(e) if e != "X" else 0.0 for e in elements])
    return atoms.names, elements, masses if atoms.masses is None else atoms.masses, atoms.position


def _choose(path: Path, frames: list[Callable[[], Atoms]], frame: int | None) -> Callable[[], Atoms]:
    if frame is None and path.suffix.lower() == ASE_TRAJECTORY:
        frame = -1
    if frame is None:
        if len(frames) > 1:
            hint = f"structure.frame (1 to {len(frames)}, -1 for the last)"
            raise structure_error(
                path, f"holds {len(frames)} structures: keep one, or for a start select one by {hint}"
            )
        frame = 1
    if not frames:
        raise structure_error(path, "holds no atoms")
    if not 1 <= abs(frame) <= len(frames):
        available = f"it holds {len(frames)}, 1 is the first and -1 the last"
        raise structure_error(path, f"structure.frame is {frame}: {available}")
    return frames[frame - 1 if frame > 0 else frame]


def _frames(path: Path, atom_types: dict[str, str] | None, content: bytes | None) -> list[Callable[[], Atoms]]:
    """For each structure of a file, a function that reads it."""
    content = _content(path) if content is None else content
    name = Path(path.stem if path.suffix.lower() in PACKED else path.name)
    suffix = name.suffix.lower()
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    # Titles may have any encoding, data are ASCII. Windows begins files with a mark of the encoding.
    text = content.decode("utf-16" if wide else "utf-8-sig", errors="replace")
    if not text.strip():
        raise structure_error(path, "holds no atoms: it is empty")
    reader = READERS.get(suffix) or next((r for begin, r in BEGINNINGS if begin.search(text[:BEGINNING])), None)
    if atom_types is not None and reader not in WITH_TYPES:
        raise structure_error(path, NO_TYPES)
    if reader is not None:
        return reader(path, text.splitlines(), *([atom_types] if reader in WITH_TYPES else []))
    with tempfile.TemporaryDirectory() as folder:
        source = path
        if name.name != path.name or wide or content.startswith(codecs.BOM_UTF8):
            source = Path(folder) / name.name
            source.write_bytes(text.encode() if wide else content.removeprefix(codecs.BOM_UTF8))
        found = read_by_ase(path, source)
    # the masses in ASE's trajectories, if they are not its standard ones
    masses = [atoms.get_masses() if suffix == ASE_TRAJECTORY and atoms.has("masses") else None for atoms in found]
    return [partial(from_ase, path, atoms, masses=of_atoms) for atoms, of_atoms in zip(found, masses, strict=True)]


def _content(path: Path) -> bytes:
    """The uncompressed content of a file. Raises StructureError."""
    if (opened := PACKED.get(path.suffix.lower())) is None:
        return path.read_bytes()
    pieces, size = [], 0
    try:
        with opened(path) as file:
            while piece := file.read(PIECE):
                pieces.append(piece)
                size += len(piece)
                reading = f"reading the {format_gigabytes(size)} that it unpacks to"
                if shortage := memory_shortage(FOR_BYTE * size, reading):
                    raise structure_error(path, f"not enough memory: {shortage}")
    except (OSError, EOFError, zlib.error, lzma.LZMAError) as error:
        raise structure_error(path, f"cannot be unpacked: {error}. Is it damaged?") from None
    return b"".join(pieces)
