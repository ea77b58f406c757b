"""Structure files read through ASE, with corrections before and after for .xyz."""

import io
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rigidmd.core.process import ignore_warnings
from rigidmd.core.toml import parse_whole_number
from rigidmd.io.atoms import HEAVY_HYDROGEN, Atoms, is_element, structure_error
from rigidmd.io.formats.text import atom_count, numbers, without_fortran

if TYPE_CHECKING:
    from ase import Atoms as AseAtoms

#: ASE's unit of velocity, sqrt(eV/u), in Å/ps.
ASE_VELOCITY = 98.22694788464063
#: ASE's arrays of names of atoms and residues, as from .pdb. Extended XYZ may have them as columns.
NAMES, RESIDUE_NAMES, RESIDUE_NUMBERS = "atomtypes", "residuenames", "residuenumbers"
#: Columns of velocities in extended XYZ that ASE does not convert, because programs use different units.
UNITLESS_VELOCITIES = ("vel", "velo", "velocity", "velocities")


def read_by_ase(path: Path, source: Path | io.StringIO, **options: Any) -> "list[AseAtoms]":
    """The structures in a file or text. Raises StructureError."""
    import ase.io.formats

    try:
        with ignore_warnings():
            found = cast("list[AseAtoms]", ase.io.read(source, index=":", **options))
    except ase.io.formats.UnknownFileTypeError:
        known = ".gro, .pdb, .xyz, .cif and LAMMPS' .data are among the known formats"
        raise structure_error(path, f"its format is unknown to ASE; {known}") from None
    except Exception as error:  # ASE's readers raise many types, from ImportError to IndexError
        reason = " ".join(str(error).split()).rstrip(".") or "something is missing or misplaced"
        hint = "Is the file complete and named by its format? A .xyz, .pdb or .gro made of it may help"
        message = f"ASE, which reads this format, ends with {type(error).__name__}: {reason}. {hint}"
        raise structure_error(path, message) from None
    return [atoms for atoms in found if len(atoms)]


def from_ase(path: Path, atoms, names=None, elements=None, residue=None, masses=None, notes=()) -> Atoms:
    """Atoms in Å, ps and u from ASE's. By default, names and elements are ASE's symbols."""
    symbols = atoms.get_chemical_symbols()
    notes = list(notes)
    if names is not None and len(names) != len(atoms):
        raise structure_error(path, f"has {len(names)} atoms, of which ASE reads {len(atoms)}")
    occupied = {(e, x) for site in (atoms.info.get("occupancy") or {}).values() for e, x in site.items()}
    if invalid := sorted({str(x) for _, x in occupied if not (isinstance(x, int | float) and x >= 0)}):
        raise structure_error(path, f"some of its sites have the occupancy {', '.join(invalid)}")
    if partial_sites := sorted(f"{e} {x:g}" for e, x in occupied if x < 1):
        found = f"some of its sites are occupied only partly ({', '.join(partial_sites)}): the crystal is disordered"
        hint = "in which every site is occupied or left out (for ices, GenIce makes proton-disordered ones)"
        raise structure_error(path, f"{found}, so that molecules are unknown. Give one arrangement of it, {hint}")
    velocity = atoms.get_velocities() * ASE_VELOCITY if atoms.has("momenta") else None
    if velocity is not None and not np.isfinite(velocity).all():
        bad = int(np.argmin(np.isfinite(velocity).all(axis=1)))
        raise structure_error(path, f"atom {bad + 1} has a velocity that is not a finite number")
    if unitless := [key for key in UNITLESS_VELOCITIES if key in atoms.arrays]:
        notes.append(f"the column {unitless[0]} has no units and is not used (ASE writes momenta instead)")
    cell = None
    if atoms.pbc.all():
        cell = atoms.cell.array.copy()
    elif atoms.pbc.any():
        axes = ", ".join(x for x, periodic in zip("abc", atoms.pbc, strict=True) if periodic)
        notes.append(f"its cell is periodic along {axes} only and is not used")
    return Atoms(
        symbols if names is None else names, symbols if elements is None else elements,
        [()] * len(atoms) if residue is None else residue, atoms.get_positions(), velocity, cell, masses, notes,
    )  # fmt: skip


def read_xyz(path: Path, lines: list[str], atom_types: dict[str, str] | None = None) -> list[Callable[[], Atoms]]:
    """The frames of a plain or extended .xyz through ASE, which needs elements, while many files have names.
    `atom_types`: name in the file, such as a type of LAMMPS -> name of the atom."""
    labels, clean, at = [], [], 0
    while at < len(lines):
        if not lines[at].strip():
            at += 1
            continue
        count = atom_count(path, at + 1, lines[at].strip(), len(lines) - at - 2)
        clean += [lines[at], re.sub(r"(?<=[\d.])[dD](?=[-+]?\d)", "e", lines[at + 1])]
        properties = re.search(r"Properties=\"?([^\s\"]+)", lines[at + 1], re.IGNORECASE)
        column, place, width = _columns(properties[1]) if properties else (0, 1, 4)
        what = f"{width} columns, {properties[1]}" if properties else "an atom of an .xyz: name, x, y, z"
        lattice = re.search(r"\blattice=\"([^\"]*)\"", clean[-1], re.IGNORECASE)
        if lattice and len(numbers(path, at + 2, lattice[1].split(), "numbers of Lattice")) not in (3, 9):
            raise structure_error(path, f"line {at + 2}: expected nine numbers of Lattice, found {lattice[1]!r}")
        for k in range(at + 2, at + 2 + count):
            words = lines[k].split()
            if len(words) < width:
                raise structure_error(path, f"line {k + 1}: expected {what}, found {lines[k].strip()[:60]!r}")
            if place is not None:
                numbers(path, k + 1, words[place : place + 3], what)
            words = [word if i == column else without_fortran(word) for i, word in enumerate(words)]
            labels.append(None)
            if column is not None:
                labels[-1] = _label(words[column], atom_types)
                _, symbol = labels[-1]
                words[column] = "H" if symbol in HEAVY_HYDROGEN else symbol or "X"
            clean.append(" ".join(words))
        at += 2 + count
    frames, first = [], 0
    for atoms in read_by_ase(path, io.StringIO("\n".join(clean) + "\n"), format="extxyz") if clean else []:
        of_frame = labels[first : first + len(atoms)]
        first += len(atoms)
        named = len(of_frame) == len(atoms) and None not in of_frame
        names, elements = map(list, zip(*of_frame, strict=True)) if named else (None, None)
        if NAMES in atoms.arrays:
            names = [str(name) for name in atoms.arrays[NAMES]]
        masses = atoms.get_masses() if atoms.has("masses") else None
        frames.append(partial(from_ase, path, atoms, names, elements, _residues(atoms), masses))
    return frames


def _label(name: str, atom_types: dict[str, str] | None) -> tuple[str, str]:
    """Name and element of an atom. The name in the file may be that of a type, or an atomic number."""
    from ase.data import chemical_symbols

    name = (atom_types or {}).get(name, name)
    if (number := parse_whole_number(name)) is not None and 0 < number < len(chemical_symbols):
        name = chemical_symbols[number]
    symbol = name.capitalize()
    return name, symbol if is_element(symbol) or symbol in HEAVY_HYDROGEN else ""


def _residues(atoms) -> list[tuple] | None:
    """Residues from ASE's arrays of them; None without."""
    if not {RESIDUE_NAMES, RESIDUE_NUMBERS} <= set(atoms.arrays):
        return None
    numbers = atoms.arrays[RESIDUE_NUMBERS]
    if numbers.dtype.kind != "i":
        return None
    return [(int(n), str(name)) for n, name in zip(numbers, atoms.arrays[RESIDUE_NAMES], strict=True)]


def _columns(properties: str) -> tuple[int | None, int | None, int]:
    """Columns of the species and of the positions, or None, and the number of columns: 0, 1 and 4 for
    `species:S:1:pos:R:3`."""
    words, column, found = properties.split(":"), 0, {}
    for name, _, width in zip(words[::3], words[1::3], words[2::3], strict=False):
        found["species" if name.lower() == "symbols" else name.lower()] = column
        column += 1 if (columns := parse_whole_number(width)) is None else columns
    return found.get("species"), found.get("pos"), column
