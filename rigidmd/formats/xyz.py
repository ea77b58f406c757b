"""XYZ, plain and extended. ASE reads it, with corrections before and after: it refuses names that
are not elements, atomic numbers in plain files, Fortran's exponents and empty lines. MDAnalysis
reads no box."""

import io
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from rigidmd.core.toml import parse_whole_number
from rigidmd.formats import Encode, Format, Placed, register
from rigidmd.formats.atoms import (
    HEAVY_HYDROGEN,
    Atoms,
    Frame,
    atom_count,
    element_of_symbol,
    last_digit,
    numbers,
    structure_error,
    unexpected,
    without_fortran,
)
from rigidmd.formats.through_ase import (
    NAMES,
    RESIDUE_NAMES,
    RESIDUE_NUMBERS,
    UNITLESS_VELOCITIES,
    from_ase,
    read_by_ase,
)
from rigidmd.formats.through_mdanalysis import FrameFiles

#: Columns of extended XYZ that are used, that are named in other notes, or that no start needs.
USED = {"species", "pos", "z", "momenta", "masses", NAMES, RESIDUE_NAMES, RESIDUE_NUMBERS}
USED |= {*UNITLESS_VELOCITIES, "forces", "force", "magmoms", "tags", "move_mask", "id"}


class Columns(NamedTuple):
    """The columns of a frame, as given in its comment."""

    comment: str  # as ASE reads it
    species: int | None  # columns
    position: int | None  # the first of three
    width: int  # least number of columns
    properties: str  # empty in a plain .xyz
    unused: tuple[str, ...]

    @property
    def expected(self) -> str:
        if self.properties:
            return f"{self.width} columns, {self.properties}"
        return "an atom of an .xyz: name, x, y, z"


def read_xyz(
    path: Path, lines: list[str], atom_types: dict[str, str] | None = None
) -> list[Callable[[], Atoms]]:
    """The frames of a plain or extended .xyz through ASE, which needs elements, while many files
    have names. `atom_types`: name in the file, such as a type of LAMMPS -> name of the atom."""
    labels = []
    roundings, notes = [], []  # of each frame with atoms
    clean = []
    at = 0
    while at < len(lines):
        if not lines[at].strip():
            at += 1
            continue
        count = atom_count(path, at + 1, lines[at].strip(), len(lines) - at - 2)
        columns = _columns(path, at + 2, lines[at + 1])
        clean += [lines[at], columns.comment]
        coordinates: list[str] = []
        further = 0
        for k in range(at + 2, at + 2 + count):
            words = lines[k].split()
            if len(words) < columns.width:
                raise unexpected(path, k + 1, columns.expected, lines[k].strip())
            further = max(further, len(words) - columns.width)
            if (place := columns.position) is not None:
                numbers(path, k + 1, words[place : place + 3], columns.expected)
                coordinates += words[place : place + 3]
            column = columns.species
            words = [word if i == column else without_fortran(word) for i, word in enumerate(words)]
            labels.append(None)
            if column is not None:
                labels[-1] = _label(words[column], atom_types)
                _, symbol = labels[-1]
                words[column] = "H" if symbol in HEAVY_HYDROGEN else symbol.capitalize() or "X"
            clean.append(" ".join(words))
        if count:
            roundings.append(last_digit(coordinates) if coordinates else 0.0)
            unused = [*columns.unused, *([f"after the first {columns.width}"] * (further > 0))]
            notes.append([f"its columns {', '.join(unused)} are not used"] if unused else [])
        at += 2 + count
    frames = []
    first = 0
    read = read_by_ase(path, io.StringIO("\n".join(clean) + "\n"), "extxyz") if clean else []
    if len(read) != len(roundings):
        problem = f"ASE reads {len(read)} of its {len(roundings)} structures"
        raise structure_error(path, f"{problem}: is the key Properties of each valid?")
    for atoms, rounding, of_columns in zip(read, roundings, notes, strict=True):
        of_frame = labels[first : first + len(atoms)]
        first += len(atoms)
        named = len(of_frame) == len(atoms) and None not in of_frame
        names, elements = map(list, zip(*of_frame, strict=True)) if named else (None, None)
        if NAMES in atoms.arrays:
            names = [str(name) for name in atoms.arrays[NAMES]]
        make = partial(from_ase, path, atoms, names, elements)
        frames.append(partial(make, rounding=rounding, notes=of_columns))
    return frames


def _label(name: str, atom_types: dict[str, str] | None) -> tuple[str, str]:
    """Name and element of an atom, as of `element_of_symbol`. The name in the file may be that of a
    type, or an atomic number."""
    from ase.data import chemical_symbols

    name = (atom_types or {}).get(name, name)
    if (number := parse_whole_number(name)) is not None and 0 < number < len(chemical_symbols):
        name = chemical_symbols[number]
    return name, element_of_symbol(name)


def _columns(path: Path, line: int, comment: str) -> Columns:
    """The columns of a frame, by the key Properties in its comment: species:S:1:pos:R:3 as in a
    plain .xyz without one."""
    comment = re.sub(r"(?<=[\d.])[dD](?=[-+]?\d)", "e", comment)
    for key in ("Lattice", "Properties", "pbc"):  # ASE knows them in these letters
        comment = re.sub(rf"(?<!\S){key}(?=\s*=)", key, comment, flags=re.IGNORECASE)
    lattice = re.search(r"\bLattice=\"([^\"]*)\"", comment)
    what = "nine numbers of Lattice"
    if lattice and len(numbers(path, line, lattice[1].split(), what)) not in (3, 9):
        raise unexpected(path, line, what, lattice[1])
    properties = re.search(r"Properties=\"?([^\s\"]+)", comment)
    if not properties:
        return Columns(comment, 0, 1, 4, "", ())
    words = properties[1].split(":")
    column = 0
    column_of = {}
    for name, _, width in zip(words[::3], words[1::3], words[2::3], strict=False):
        column_of["species" if name.lower() == "symbols" else name.lower()] = column
        column += 1 if (count := parse_whole_number(width)) is None else count
    return Columns(
        comment,
        column_of.get("species"),
        column_of.get("pos"),
        column,
        properties[1],
        tuple(name for name in column_of if name not in USED),
    )


def encoder(system: Placed, interval: float, velocities: bool) -> Encode:
    """Extended XYZ, for OVITO and ASE: box and time are in the comment line."""
    files = FrameFiles(system, velocities=velocities, name="XYZ")
    # names of all sites, where elements do not name all that have mass
    nameless = bool(((system.sites.element == "X") & (system.sites.mass > 0)).any())
    names = [f" {name}\n".encode() for name in system.sites.name] if nameless else []
    column = f":{NAMES}:S:1" if nameless else ""

    def encode(frame: Frame, k: int) -> bytes:
        box = 'pbc="F F F"'
        if frame.cell is not None:
            box = f'Lattice="{" ".join(f"{x:.9g}" for x in frame.cell.flat)}" pbc="T T T"'

        def write(writer, atoms):
            writer.remark = f"{box} Properties=species:S:1:pos:R:3{column} Time={frame.time:.9g}"
            writer.write(atoms)

        text = files.content(frame, write).removesuffix(b"\n\n") + b"\n"
        if not names:
            return text
        head = text.splitlines(keepends=True)[:2]
        rows = text.splitlines()[2:]
        return b"".join([*head, *(row + name for row, name in zip(rows, names, strict=True))])

    return encode


register(
    Format(
        (".xyz", ".extxyz"),
        read=read_xyz,
        has_types=True,
        encoder=encoder,
        content=re.compile(r"\A\s*\d+[ \t]*\n.*\n[ \t]*[A-Za-z]\w*([ \t]+-?\d*\.?\d+){3}"),
        times=re.compile(rb'(?:Lattice="([^"]*)" )?pbc=.* Time=(\S+)'),
    )
)
