"""The atoms of a structure file of any format, read through ASE or by the readers in
`formats`."""

import bz2
import codecs
import gzip
import lzma
import tempfile
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from rigidmd.core.files import unreadable_reason
from rigidmd.core.process import format_gigabytes, memory_shortage
from rigidmd.errors import UNPRINTABLE
from rigidmd.formats import Format, all_formats, format_of, topologies
from rigidmd.formats.atoms import HEAVY_HYDROGEN, Atoms, element_of, structure_error, with_elements
from rigidmd.formats.through_ase import from_ase, read_by_ase, read_text_by_ase
from rigidmd.formats.through_mdanalysis import index_of, read_in_process
from rigidmd.scene.validation import not_none

FARTHEST = 1e9  # Å, of an atom from the origin
HEAVIEST = 1e30  # u
FOR_BYTE = 20  # bytes of memory per byte of a file, for lines and words as text, and numbers
NO_VOLUME = 1e-9  # of a cell, relative to the cube of its longest edge
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
    """The atoms in a file, or in one of its structures. Raises StructureError.

    frame: 1 for the first, -1 for the last. None for the only structure of a file, or the last of a
    trajectory. atom_types: names of types, for formats with types. topology: a file with the names
    that a trajectory lacks. content: the content of the file, if it is not read from `path`, which
    is then only its name.
    """
    if content is None and (reason := unreadable_reason(path)):
        raise structure_error(path, reason)
    form = format_of(path)
    if form is not None and form.is_trajectory:
        atoms = _read_trajectory(path, form, -1 if frame is None else frame, atom_types, topology)
    else:
        size = path.stat().st_size if content is None else len(content)
        if shortage := memory_shortage(FOR_BYTE * size, f"reading its {format_gigabytes(size)}"):
            raise structure_error(path, f"not enough memory: {shortage}")
        with np.errstate(all="ignore"):  # what is not finite is refused below
            atoms = _choose(path, _frames(path, atom_types, content), frame)()
    if len(atoms.position) == 0:
        raise structure_error(path, "holds no atoms")
    for what, values in (
        ("position", atoms.position),
        ("velocity", atoms.velocity),
        ("cell", atoms.cell),
    ):
        if what == "velocity" and not (form and form.is_trajectory):
            continue  # some atoms may have none
        if values is not None and not np.isfinite(values).all():
            bad = int(np.argmin(np.isfinite(values).all(axis=1)))
            owner = "its box has an edge" if what == "cell" else f"atom {bad + 1} has a {what}"
            raise structure_error(path, f"{owner} that is not a finite number")
    if (far := np.abs(atoms.position).max()) > FARTHEST:
        raise structure_error(
            path, f"an atom is at {far:.3g} Å, farther than {FARTHEST:g} Å: is this the unit?"
        )
    if atoms.masses is not None and not ((atoms.masses >= 0) & (atoms.masses < HEAVIEST)).all():
        raise structure_error(path, "an atom has a mass that is negative, too large or no number")
    for k, texts in enumerate(zip(atoms.names, atoms.elements, atoms.residue, strict=True), 1):
        if any(UNPRINTABLE.search(str(text)) for text in (*texts[:2], *texts[2])):
            raise structure_error(
                path, f"atom {k} has a name with control characters: {texts[0]!r}"
            )
    return _without_placeholder(atoms)


def _without_placeholder(atoms: Atoms) -> Atoms:
    """The atoms without a cell that stands for none: a cell without volume, or the cube of 1 Å in
    PDB files."""
    if atoms.cell is None:
        return atoms
    longest = np.linalg.norm(atoms.cell, axis=1).max()
    if np.abs(np.linalg.det(atoms.cell)) <= NO_VOLUME * longest**3:
        note = ["its cell has no volume and is not used"] if longest else []
        return atoms._replace(cell=None, notes=[*atoms.notes, *note])
    if np.allclose(atoms.cell, np.eye(3), rtol=0, atol=1e-6):
        return atoms._replace(
            cell=None, notes=[*atoms.notes, "its cell, a cube of 1 Å, stands for none"]
        )
    return atoms


def _read_trajectory(
    path: Path, form: Format, frame: int, atom_types, topology: Path | None
) -> Atoms:
    """The atoms of a frame, with the names in the topology file if the format has none."""
    if form.read_arrays is None:
        if atom_types is not None and not form.has_types:
            raise structure_error(path, _no_types())
        return not_none(form.read_frame)(path, frame, *([atom_types] if form.has_types else []))
    if topology is None:
        missing = f"there is no {' or '.join(topologies())} next to it"
        raise structure_error(
            path, f"holds no names of atoms, and {missing}: name a file by structure.topology"
        )
    atoms = read_atoms(topology, None, atom_types)
    arrays = read_in_process(form.read_arrays, path, frame, len(atoms.names))
    return atoms._replace(
        position=arrays["position"], velocity=arrays.get("velocity"), cell=arrays.get("cell")
    )


def _no_types() -> str:
    names = [form.name or " ".join(form.extensions) for form in all_formats() if form.has_types]
    return f"structure.atom_types is for formats whose atoms have types: {', '.join(sorted(names))}"


def read_geometry(path: Path, vocabulary: frozenset[str] = frozenset()) -> Atoms:
    """The atoms of a file with one molecule, with elements and masses of all. `vocabulary`:
    elements of the entries of parameters, by which names are understood."""
    from ase.data import atomic_masses, atomic_numbers

    if (form := format_of(path)) is not None and form.is_trajectory:
        raise structure_error(
            path, "is a trajectory: name a structure file, or write one of its frames as a file"
        )
    atoms = read_atoms(path)
    # next to C, CO is cobalt
    atoms = with_elements(atoms, vocabulary.difference(atoms.elements))
    elements = [
        e or element_of(name, vocabulary) or "X"
        for e, name in zip(atoms.elements, atoms.names, strict=True)
    ]
    masses = atoms.masses
    if masses is None:
        known = {"X": 0.0} | HEAVY_HYDROGEN
        masses = np.array(
            [known[e] if e in known else atomic_masses[atomic_numbers[e]] for e in elements]
        )
    return atoms._replace(elements=elements, masses=masses)


def _choose(
    path: Path, frames: list[Callable[[], Atoms]], frame: int | None
) -> Callable[[], Atoms]:
    if frame is None:
        form = format_of(path)
        frame = -1 if form is not None and form.read is None else 1
        if frame == 1 and len(frames) > 1:
            hint = (
                f"keep one, or for a start select one by structure.frame (1 to {len(frames)}, -1"
                " for the last)"
            )
            raise structure_error(path, f"holds {len(frames)} structures: {hint}")
    if not frames:
        raise structure_error(path, "holds no atoms")
    try:
        return frames[index_of(len(frames), frame)]
    except ValueError as error:
        raise structure_error(path, str(error)) from None


def _frames(
    path: Path, atom_types: dict[str, str] | None, content: bytes | None
) -> list[Callable[[], Atoms]]:
    """For each structure of a file, a function that reads it."""
    content = _content(path) if content is None else content
    name = Path(path.stem if path.suffix.lower() in PACKED else path.name)
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    # Titles may have any encoding, data are ASCII. Windows begins files with a mark of the
    # encoding.
    text = content.decode("utf-16" if wide else "utf-8-sig", errors="replace")
    if not text.strip():
        raise structure_error(path, "holds no atoms: it is empty")
    recognised = (
        form for form in all_formats() if form.content and form.content.search(text[:BEGINNING])
    )
    form = format_of(name) or next(recognised, None)
    if atom_types is not None and not (form and form.has_types):
        raise structure_error(path, _no_types())
    if form is not None and form.read is not None:
        return form.read(path, text.splitlines(), *([atom_types] if form.has_types else []))
    if (is_binary := b"\0" in content and not wide) and name.name == path.name:
        return [partial(from_ase, path, atoms) for atoms in read_by_ase(path, path)]
    if is_binary:
        with tempfile.TemporaryDirectory() as folder:
            source = Path(folder) / name.name
            source.write_bytes(content)
            return [partial(from_ase, path, atoms) for atoms in read_by_ase(path, source)]
    return [partial(from_ase, path, atoms) for atoms in read_text_by_ase(path, text, name.name)]


def _content(path: Path) -> bytes:
    """The uncompressed content of a file. Raises StructureError."""
    if (opened := PACKED.get(path.suffix.lower())) is None:
        return path.read_bytes()
    pieces = []
    size = 0
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
