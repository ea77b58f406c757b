"""XYZ, plain and extended. ASE reads it, with corrections before and after."""

import io
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

from rigidmd.core.toml import parse_whole_number
from rigidmd.formats import Encode, Format, System, register
from rigidmd.formats.atoms import (
    HEAVY_HYDROGEN,
    Atoms,
    Frame,
    atom_count,
    element_of_symbol,
    last_digit,
    numbers,
    unexpected,
    without_fortran,
)
from rigidmd.formats.through_ase import NAMES, from_ase, read_by_ase
from rigidmd.formats.through_mdanalysis import FrameFiles


def read_xyz(
    path: Path, lines: list[str], atom_types: dict[str, str] | None = None
) -> list[Callable[[], Atoms]]:
    """The frames of a plain or extended .xyz through ASE, which needs elements, while many files
    have names. `atom_types`: name in the file, such as a type of LAMMPS -> name of the atom."""
    labels = []
    roundings = []  # of each frame
    clean = []
    at = 0
    while at < len(lines):
        if not lines[at].strip():
            at += 1
            continue
        count = atom_count(path, at + 1, lines[at].strip(), len(lines) - at - 2)
        clean += [lines[at], re.sub(r"(?<=[\d.])[dD](?=[-+]?\d)", "e", lines[at + 1])]
        properties = re.search(r"Properties=\"?([^\s\"]+)", lines[at + 1], re.IGNORECASE)
        column, place, width = _columns(properties[1]) if properties else (0, 1, 4)
        if properties:
            what = f"{width} columns, {properties[1]}"
        else:
            what = "an atom of an .xyz: name, x, y, z"
        lattice = re.search(r"\blattice=\"([^\"]*)\"", clean[-1], re.IGNORECASE)
        if lattice and len(numbers(path, at + 2, lattice[1].split(), "numbers of Lattice")) not in (
            3,
            9,
        ):
            raise unexpected(path, at + 2, "nine numbers of Lattice", lattice[1])
        coordinates: list[str] = []
        for k in range(at + 2, at + 2 + count):
            words = lines[k].split()
            if len(words) < width:
                raise unexpected(path, k + 1, what, lines[k].strip())
            if place is not None:
                numbers(path, k + 1, words[place : place + 3], what)
                coordinates += words[place : place + 3]
            words = [word if i == column else without_fortran(word) for i, word in enumerate(words)]
            labels.append(None)
            if column is not None:
                labels[-1] = _label(words[column], atom_types)
                _, symbol = labels[-1]
                words[column] = "H" if symbol in HEAVY_HYDROGEN else symbol.capitalize() or "X"
            clean.append(" ".join(words))
        if count:
            roundings.append(last_digit(coordinates) if coordinates else 0.0)
        at += 2 + count
    frames = []
    first = 0
    read = read_by_ase(path, io.StringIO("\n".join(clean) + "\n"), "extxyz") if clean else []
    for atoms, rounding in zip(read, roundings, strict=True):
        of_frame = labels[first : first + len(atoms)]
        first += len(atoms)
        named = len(of_frame) == len(atoms) and None not in of_frame
        names, elements = map(list, zip(*of_frame, strict=True)) if named else (None, None)
        if NAMES in atoms.arrays:
            names = [str(name) for name in atoms.arrays[NAMES]]
        frames.append(partial(from_ase, path, atoms, names, elements, rounding=rounding))
    return frames


def _label(name: str, atom_types: dict[str, str] | None) -> tuple[str, str]:
    """Name and element of an atom, as of `element_of_symbol`. The name in the file may be that of a
    type, or an atomic number."""
    from ase.data import chemical_symbols

    name = (atom_types or {}).get(name, name)
    if (number := parse_whole_number(name)) is not None and 0 < number < len(chemical_symbols):
        name = chemical_symbols[number]
    return name, element_of_symbol(name)


def _columns(properties: str) -> tuple[int | None, int | None, int]:
    """Columns of species and positions, or None, and their number: 0, 1 and 4 for
    `species:S:1:pos:R:3`."""
    words = properties.split(":")
    column = 0
    column_of = {}
    for name, _, width in zip(words[::3], words[1::3], words[2::3], strict=False):
        column_of["species" if name.lower() == "symbols" else name.lower()] = column
        column += 1 if (columns := parse_whole_number(width)) is None else columns
    return column_of.get("species"), column_of.get("pos"), column


def encoder(system: System, interval: float, velocities: bool) -> Encode:
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
