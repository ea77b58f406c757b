"""Structure files read through ASE, with corrections before or after for .pdb, .xyz and LAMMPS data."""

import io
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rigidmd.assemble.atoms import HEAVY_HYDROGEN, Atoms, element_of_mass, is_element
from rigidmd.assemble.own_formats import promised_atoms
from rigidmd.core.process import quiet
from rigidmd.core.toml_text import whole_number
from rigidmd.errors import StructureError

if TYPE_CHECKING:
    from ase import Atoms as AseAtoms

#: ASE's unit of velocity, sqrt(eV/u), in Å/ps.
ASE_VELOCITY = 98.22694788464063
#: Arrays in which ASE keeps names of atoms and their residues, as of .pdb; extended XYZ may have them as columns.
NAMES, RESIDUE_NAMES, RESIDUE_NUMBERS = "atomtypes", "residuenames", "residuenumbers"
#: Columns of velocities in extended XYZ that ASE does not convert, as programs differ in their units.
UNITLESS_VELOCITIES = ("vel", "velo", "velocity", "velocities")


def read_by_ase(path: Path, source: Path | io.StringIO, **options: Any) -> "list[AseAtoms]":
    """The structures in a file or text. Raises StructureError."""
    import ase.io.formats

    try:
        with quiet():
            found = cast("list[AseAtoms]", ase.io.read(source, index=":", **options))
    except ase.io.formats.UnknownFileTypeError:
        raise StructureError(
            str(path), ["its format is unknown to ASE; .gro, .pdb, .xyz, .cif and LAMMPS' .data are among the known"]
        ) from None
    except Exception as error:  # ASE's readers raise many types, from ImportError to IndexError
        raise StructureError(str(path), [f"ASE cannot read it: {type(error).__name__}: {error}"]) from None
    return [atoms for atoms in found if len(atoms)]


def from_ase(path: Path, atoms, names=None, elements=None, residue=None, masses=None, notes=()) -> Atoms:
    """Atoms from ASE's, in our units. Names and elements that are not given are ASE's symbols."""
    symbols = atoms.get_chemical_symbols()
    notes = list(notes)
    if names is not None and len(names) != len(atoms):
        raise StructureError(str(path), [f"has {len(names)} atoms, of which ASE reads {len(atoms)}"])
    shares = {(e, s) for site in (atoms.info.get("occupancy") or {}).values() for e, s in site.items()}
    if untold := sorted({str(s) for _, s in shares if not (isinstance(s, int | float) and s >= 0)}):
        raise StructureError(str(path), [f"says of some of its sites that they are occupied by {', '.join(untold)}"])
    if shares := sorted(f"{e} {s:g}" for e, s in shares if s < 1):
        raise StructureError(
            str(path),
            [
                f"some of its sites are occupied only partly ({', '.join(shares)}): the crystal is disordered, and "
                "where the molecules are is open. Give one arrangement of it, in which every site is occupied or left "
                "out (for ices, GenIce makes proton-disordered ones)"
            ],
        )
    velocity = atoms.get_velocities() * ASE_VELOCITY if atoms.has("momenta") else None
    if velocity is not None and not np.isfinite(velocity).all():
        bad = int(np.argmin(np.isfinite(velocity).all(axis=1)))
        raise StructureError(str(path), [f"atom {bad + 1} has a velocity that is not a finite number"])
    if unitless := [key for key in UNITLESS_VELOCITIES if key in atoms.arrays]:
        notes.append(f"the column {unitless[0]} does not say its units and is not used (ASE writes momenta instead)")
    cell = None
    if atoms.pbc.all():
        cell = atoms.cell.array.copy()
    elif atoms.pbc.any():
        axes = ", ".join(x for x, periodic in zip("abc", atoms.pbc, strict=True) if periodic)
        notes.append(f"its cell is periodic along {axes} only and is not used")
    return Atoms(
        symbols if names is None else names,
        symbols if elements is None else elements,
        [()] * len(atoms) if residue is None else residue,
        atoms.get_positions(),
        velocity,
        cell,
        masses,
        notes,
    )


def read_pdb(path: Path, lines: list[str]) -> list[Callable[[], Atoms]]:
    """The models of a .pdb, each with the last CRYST1 before it (which ASE forgets from model to model)."""
    models, cryst, body = [], [], []
    ends = next((line for line in reversed(lines) if line.strip()), "")
    notes = ["it ends with an atom, without END: is it truncated?"] if ends.startswith(("ATOM", "HETATM")) else []
    for number, line in enumerate([*lines, "END"], 1):
        if line.startswith("CRYST1"):
            if len(line[6:54].split()) < 6:
                raise StructureError(
                    str(path), [f"line {number}: CRYST1 needs three edges and three angles, found {line[6:].strip()!r}"]
                )
            cryst = [line]
        elif line.startswith(("ATOM", "HETATM")):
            body.append(line)
        elif line.startswith("ORIGX"):
            cryst = [*cryst, line]
        elif line.startswith("END") and body:
            models.append(partial(_pdb_model, path, cryst, body, notes if number > len(lines) else []))
            body = []
    return models


def _pdb_model(path: Path, head: list[str], body: list[str], notes: list[str]) -> Atoms:
    """One model through ASE, in lines as ASE expects them: an element in each, residues numbered anew."""
    if len(places := {line[16:17] for line in body} - {"", " "}) > 1:
        raise StructureError(str(path), [f"has alternate locations {', '.join(sorted(places))}; keep one of them"])
    names, elements, residue, lines = [], [], [], []
    count, last = 0, None
    for line in body:
        symbol = line[76:78].strip().capitalize()
        names.append(line[12:16].strip())
        elements.append(symbol if is_element(symbol) or symbol in HEAVY_HYDROGEN else "")
        if (here := line[17:27]) != last:  # name, chain, number and insertion code: numbers alone wrap or run out
            count, last = count + 1, here
        number = line[22:26].strip()
        residue.append((whole_number(number), line[17:21].strip(), count))
        lines.append(f"{line[:22]:22}{count % 10000:4d}{line[26:76]:50} X")
    found = read_by_ase(path, io.StringIO("\n".join([*head, *lines]) + "\n"), format="proteindatabank")
    if not found:
        raise StructureError(str(path), ["holds no atoms that ASE can read"])
    if count == 1 and not residue[0][1]:
        residue = [()] * len(names)
    return from_ase(path, found[0], names, elements, residue, notes=notes)


def read_xyz(path: Path, lines: list[str]) -> list[Callable[[], Atoms]]:
    """The frames of a plain or extended .xyz through ASE, which needs elements where many files have names."""
    labels, at = [], 0
    while at < len(lines) and lines[at].strip():
        count = promised_atoms(path, at + 1, lines[at].strip(), len(lines) - at - 2)
        properties = re.search(r"Properties=\"?([^\s\"]+)", lines[at + 1], re.IGNORECASE)
        column = _species_column(properties.group(1)) if properties else 0
        for k in range(at + 2, at + 2 + count):
            words = lines[k].split()
            if column is None or len(words) <= column:
                labels.append(None)
                continue
            name = words[column]
            symbol = name.capitalize()
            labels.append((name, symbol if is_element(symbol) or symbol in HEAVY_HYDROGEN else ""))
            words[column] = symbol if is_element(symbol) else "H" if symbol in HEAVY_HYDROGEN else "X"
            lines[k] = " ".join(words)
        at += 2 + count
    frames, first = [], 0
    for atoms in read_by_ase(path, io.StringIO("\n".join(lines) + "\n"), format="extxyz"):
        own = labels[first : first + len(atoms)]
        first += len(atoms)
        named = len(own) == len(atoms) and None not in own
        names, elements = map(list, zip(*own, strict=True)) if named else (None, None)
        if NAMES in atoms.arrays:
            names = [str(name) for name in atoms.arrays[NAMES]]
        masses = atoms.get_masses() if atoms.has("masses") else None
        frames.append(partial(from_ase, path, atoms, names, elements, _residues(atoms), masses))
    return frames


def _residues(atoms) -> list[tuple] | None:
    """Residues in the arrays that ASE has for them; None without."""
    if not {RESIDUE_NAMES, RESIDUE_NUMBERS} <= set(atoms.arrays):
        return None
    numbers = atoms.arrays[RESIDUE_NUMBERS]
    if numbers.dtype.kind != "i":
        return None
    return [(int(n), str(name)) for n, name in zip(numbers, atoms.arrays[RESIDUE_NAMES], strict=True)]


def _species_column(properties: str) -> int | None:
    """Which column holds the species: `species:S:1:pos:R:3` says 0; None if no column does."""
    words, column = properties.split(":"), 0
    for name, _, width in zip(words[::3], words[1::3], words[2::3], strict=False):
        if name.lower() in ("species", "symbols"):
            return column
        column += 1 if (columns := whole_number(width)) is None else columns
    return None


def read_lammps(path: Path, lines: list[str], atom_types: dict[str, str] | None) -> list[Callable[[], Atoms]]:
    """LAMMPS data through ASE. The first line may name the units; real and metal differ only in velocities."""
    text = "\n".join(lines) + "\n"
    if promised := re.search(r"^[ \t]*(\d+)[ \t]+atoms\b", text, re.MULTILINE):
        promised_atoms(path, text.count("\n", 0, promised.start()) + 1, promised[1], len(lines))
    listed, labels = _lammps_types(lines)
    if not listed and not labels and atom_types is None and re.search(r"^\s*Atoms\b", text, re.MULTILINE):
        fault = "has no section Masses, from which its atom types could be told: name them by structure.atom_types"
        raise StructureError(str(path), [fault])
    units = re.search(r"\bunits\s*=?\s*(real|metal|si|cgs|electron)\b", text.split("\n", 1)[0])
    try:
        found = read_by_ase(path, io.StringIO(text), format="lammps-data", units=units.group(1) if units else "metal")
    except StructureError:
        if re.search(r"^\s*0\s+atoms\b", text, re.MULTILINE):
            return []
        raise
    return [partial(_lammps_atoms, path, atoms, listed, labels, atom_types, units is not None) for atoms in found]


def _lammps_types(lines: list[str]) -> tuple[list[str], dict[str, str]]:
    """The atom types in the section Masses of LAMMPS data, and names of types from labels or one-word comments."""
    listed, labels, words, section = [], {}, {}, ""
    for line in lines[1:]:
        data, _, comment = line.partition("#")
        fields = data.split()
        if fields and all(field.isalpha() for field in fields):
            section = " ".join(fields)
        elif len(fields) == 2 and section == "Masses":
            listed.append(fields[0])
            if len(comment.split()) == 1:
                words[fields[0]] = comment.strip()
        elif len(fields) == 2 and section == "Atom Type Labels":
            labels[fields[0]] = fields[1]
    return listed, words | labels


def _lammps_atoms(
    path: Path, atoms, listed: list[str], labels: dict[str, str], atom_types: dict[str, str] | None, units_known: bool
) -> Atoms:
    """Atoms named by type, as the scene or else the file names the types; molecules are residues."""
    types = [str(t) for t in atoms.arrays["type"]]
    if atom_types is not None:
        present = sorted({*types, *listed}, key=int)
        unknown, unnamed = [t for t in atom_types if t not in present], [t for t in present if t not in atom_types]
        faults = []
        if unknown:
            faults.append(
                f"structure.atom_types: there is no type {', '.join(unknown)}; there are {', '.join(present)}"
            )
        if unnamed:
            faults.append(f"structure.atom_types does not say what type {', '.join(unnamed)} is")
        if faults:
            raise StructureError(str(path), faults)
    names = labels if atom_types is None else atom_types
    masses = atoms.get_masses() if listed else None
    of_type = {} if masses is None else dict(zip(types, masses.tolist(), strict=True))
    element = {t: element_of_mass(mass) for t, mass in of_type.items()}
    result = from_ase(
        path,
        atoms,
        [names.get(t, t) for t in types],
        [element.get(t, "") for t in types],
        [(int(n), "") for n in atoms.arrays["mol-id"]] if "mol-id" in atoms.arrays else None,
        masses,
    )
    if result.velocity is not None and not units_known:
        result.notes.append("its first line does not say its units ('units = real'): its velocities are not used")
        return result._replace(velocity=None)
    return result
