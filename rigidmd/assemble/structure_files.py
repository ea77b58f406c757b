"""Atoms out of the files that people have: through ASE, and by short readers of our own where ASE falls short.

Ours are .gro (further digits, several frames, velocities of some atoms: ASE takes none of them), Tinker's .arc and
.txyz (ASE has none, MDAnalysis keeps single precision) and .cssr (neither has one).
"""

import io
import re
import warnings
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigidmd.errors import StructureError
from rigidmd.scene.place import LAMMPS_DATA

# ASE's velocity unit (Å sqrt(u/eV)) in Å/ps.
ASE_VELOCITY = 98.22694788464063
NO_VOLUME = 1e-9  # of a cell against the cube of its longest edge
#: A column of velocities in extended XYZ that ASE keeps as it stands: programs differ in its units.
UNITLESS_VELOCITIES = ("vel", "velo", "velocity", "velocities")
SAME_MASS = 0.01  # masses nearer than this fraction are one element
HEAVY_HYDROGEN = {"D": 2.014101777844, "T": 3.01604928132}  # u, AME2020; ASE has no symbols for them
#: Names of sites without mass: M of four-site waters, L of five-site ones, and what programs call them.
MASSLESS = re.compile(r"(M|MW|MT|EPW?|LPW?[A-Z]?|LP?|LW|IW|DUM|VS|XX?|Q)\d*", re.IGNORECASE)


class Atoms(NamedTuple):
    """What a file says of n atoms, in our units."""

    names: list[str]
    elements: list[str]  # "" where the format has names only; X without mass, D and T for heavy hydrogen
    residue: list[tuple]  # (number or None, name, ...), what tells it from its neighbours; () where the format has none
    position: np.ndarray  # (n, 3) Å
    velocity: np.ndarray | None  # (n, 3) Å/ps; rows of NaN for atoms without one
    cell: np.ndarray | None  # (3, 3), rows a, b, c, Å
    masses: np.ndarray | None  # (n,) u, where the file gives them
    notes: list[str]


def read_atoms(path: Path, frame: int | None = None, atom_types: dict[str, str] | None = None) -> Atoms:
    """The atoms of a file, or of one of several structures in it. Raises StructureError.

    frame: 1 for the first, -1 for the last; None where there must be only one. atom_types: names of the types in a
    LAMMPS data file.
    """
    if not path.is_file():
        raise StructureError(str(path), ["there is no such file"])
    atoms = _choose(path, _frames(path, atom_types), frame)()
    if len(atoms.position) == 0:
        raise StructureError(str(path), ["holds no atoms"])
    for what, values in (("position", atoms.position), ("cell", atoms.cell)):
        if values is not None and not np.isfinite(values).all():
            bad = int(np.argmin(np.isfinite(values).all(axis=1)))
            owner = "its box has an edge" if what == "cell" else f"atom {bad + 1} has a position"
            raise StructureError(str(path), [f"{owner} that is not a finite number"])
    return _without_placeholder(atoms)


def _without_placeholder(atoms: Atoms) -> Atoms:
    """Without a cell that has no volume, or the cube of 1 Å that stands for none in .pdb and .cssr."""
    if atoms.cell is None:
        return atoms
    longest = np.linalg.norm(atoms.cell, axis=1).max()
    if np.abs(np.linalg.det(atoms.cell)) <= NO_VOLUME * longest**3:
        return atoms._replace(
            cell=None, notes=[*atoms.notes, "its cell has no volume and is not used"] if longest else atoms.notes
        )
    if np.allclose(atoms.cell, np.eye(3), rtol=0, atol=1e-6):
        return atoms._replace(cell=None, notes=[*atoms.notes, "its cell, a cube of 1 Å, stands for none"])
    return atoms


def read_geometry(path: Path) -> tuple[list[str], list[str], np.ndarray, np.ndarray]:
    """Names, elements, masses (s,) and positions (s, 3) of the atoms of a file that holds one molecule."""
    from ase.data import atomic_masses, atomic_numbers

    def mass(element: str) -> float:
        return HEAVY_HYDROGEN[element] if element in HEAVY_HYDROGEN else float(atomic_masses[atomic_numbers[element]])

    atoms = read_atoms(path)
    elements = [e or element_of(name) or "X" for e, name in zip(atoms.elements, atoms.names, strict=True)]
    masses = np.array([mass(e) if e != "X" else 0.0 for e in elements])
    return atoms.names, elements, masses if atoms.masses is None else atoms.masses, atoms.position


def element_of(name: str, vocabulary: frozenset[str] = frozenset()) -> str:
    """The element that an atom's name begins with, one of `vocabulary` if possible; X if massless, "" if none."""
    letters = re.match(r"[A-Za-z]*", name.lstrip("0123456789 ")).group()
    one, two = letters[:1].upper(), letters[:2].capitalize()
    if len(two) == 2 and (letters[:2] == two or letters.upper() in ("CL", "BR")) and _is_element(two):
        return two
    found = next((e for e in (two, one) if e in vocabulary), "")
    if not found and MASSLESS.fullmatch(name):
        return "X"
    return found or next((e for e in (one, two) if _is_element(e)), "")


def _is_element(symbol: str) -> bool:
    from ase.data import atomic_numbers

    return symbol != "X" and symbol in atomic_numbers


def _choose(path: Path, frames: list, frame: int | None):
    if frame is None:
        if len(frames) > 1:
            raise StructureError(
                str(path),
                [
                    f"holds {len(frames)} structures one after another: keep one, or of a start say which by "
                    f"structure.frame (1 to {len(frames)}, -1 for the last)"
                ],
            )
        frame = 1
    if not frames:
        raise StructureError(str(path), ["holds no atoms"])
    if not 1 <= abs(frame) <= len(frames):
        raise StructureError(
            str(path), [f"structure.frame is {frame}: it holds {len(frames)}, 1 is the first and -1 the last"]
        )
    return frames[frame - 1 if frame > 0 else frame]


def _frames(path: Path, atom_types: dict[str, str] | None) -> list[Callable[[], Atoms]]:
    """The structures of a file, each ready to be read."""
    if reader := READERS.get(path.suffix.lower()):
        # Titles are in any encoding; what matters is ASCII.
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        return reader(path, lines, atom_types) if reader is _lammps else reader(path, lines)
    return [partial(_from_ase, path, atoms) for atoms in _ase(path, path)]


# through ASE


def _ase(path: Path, source, **options) -> list:
    """ASE's structures in a file or in text."""
    import ase.io

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = ase.io.read(source, index=":", **options)
    except ase.io.formats.UnknownFileTypeError:
        raise StructureError(
            str(path), ["its format is unknown to ASE; .gro, .pdb, .xyz, .cif and LAMMPS' .data are among the known"]
        ) from None
    except Exception as error:  # ASE's readers raise whatever their parsing trips over, ImportError to IndexError
        raise StructureError(str(path), [f"ASE cannot read it: {type(error).__name__}: {error}"]) from None
    return [atoms for atoms in found if len(atoms)]


def _from_ase(path: Path, atoms, names=None, elements=None, residue=None, masses=None, notes=()) -> Atoms:
    """ASE's atoms in our units; names and elements as given, else by ASE's symbols."""
    symbols = atoms.get_chemical_symbols()
    notes = list(notes)
    if any(share < 1 for site in atoms.info.get("occupancy", {}).values() for share in site.values()):
        shares = sorted({f"{e} {s:g}" for site in atoms.info["occupancy"].values() for e, s in site.items() if s < 1})
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


def _pdb(path: Path, lines: list[str]) -> list[Callable[[], Atoms]]:
    """The models of a .pdb, each with the last CRYST1 before it (which ASE forgets from model to model)."""
    models, cryst, body = [], [], []
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
            models.append(partial(_pdb_model, path, cryst, body))
            body = []
    return models


def _pdb_model(path: Path, head: list[str], body: list[str]) -> Atoms:
    """One model through ASE, its lines made what ASE expects: some element in each, residues counted."""
    if len(places := {line[16:17] for line in body} - {"", " "}) > 1:
        raise StructureError(str(path), [f"has alternate locations {', '.join(sorted(places))}; keep one of them"])
    names, elements, residue, lines = [], [], [], []
    count, last = 0, None
    for line in body:
        symbol = line[76:78].strip().capitalize()
        names.append(line[12:16].strip())
        elements.append(symbol if _is_element(symbol) or symbol in HEAVY_HYDROGEN else "")
        if (here := line[17:27]) != last:  # name, chain, number and insertion code: numbers alone wrap or run out
            count, last = count + 1, here
        number = line[22:26].strip()
        residue.append((int(number) if number.isdecimal() else None, line[17:21].strip(), count))
        lines.append(f"{line[:22]:22}{count % 10000:4d}{line[26:76]:50} X")
    found = _ase(path, io.StringIO("\n".join([*head, *lines]) + "\n"), format="proteindatabank")
    if count == 1 and not residue[0][1]:
        residue = [()] * len(names)
    return _from_ase(path, found[0], names, elements, residue)


def _xyz(path: Path, lines: list[str]) -> list[Callable[[], Atoms]]:
    """The frames of a plain or extended .xyz through ASE, which wants elements where files often have names."""
    labels, at = [], 0
    while at < len(lines) and lines[at].strip():
        count = lines[at].strip()
        if not count.isdigit() or at + 2 + int(count) > len(lines):
            break  # ASE says what is wrong with it
        properties = re.search(r"Properties=\"?([^\s\"]+)", lines[at + 1], re.IGNORECASE)
        column = _species_column(properties.group(1)) if properties else 0
        for k in range(at + 2, at + 2 + int(count)):
            words = lines[k].split()
            if column is None or len(words) <= column:
                labels.append(None)
                continue
            name = words[column]
            symbol = name.capitalize()
            labels.append((name, symbol if _is_element(symbol) or symbol in HEAVY_HYDROGEN else ""))
            words[column] = symbol if _is_element(symbol) else "H" if symbol in HEAVY_HYDROGEN else "X"
            lines[k] = " ".join(words)
        at += 2 + int(count)
    frames, first = [], 0
    for atoms in _ase(path, io.StringIO("\n".join(lines) + "\n"), format="extxyz"):
        own = labels[first : first + len(atoms)]
        first += len(atoms)
        named = len(own) == len(atoms) and None not in own
        names, elements = map(list, zip(*own, strict=True)) if named else (None, None)
        frames.append(partial(_from_ase, path, atoms, names, elements))
    return frames


def _species_column(properties: str) -> int | None:
    """Which column holds the species: `species:S:1:pos:R:3` says 0; None if no column does."""
    words, column = properties.split(":"), 0
    for name, _, width in zip(words[::3], words[1::3], words[2::3], strict=False):
        if name.lower() in ("species", "symbols"):
            return column
        column += int(width) if width.isdigit() else 1
    return None


def _lammps(path: Path, lines: list[str], atom_types: dict[str, str] | None) -> list[Callable[[], Atoms]]:
    """LAMMPS data through ASE. Its first line may say the units; real and metal differ in velocities only."""
    text = "\n".join(lines) + "\n"
    listed, labels = _lammps_types(lines)
    if not listed and not labels and atom_types is None and re.search(r"^\s*Atoms\b", text, re.MULTILINE):
        fault = "has no section Masses, from which its atom types could be told: name them by structure.atom_types"
        raise StructureError(str(path), [fault])
    units = re.search(r"\bunits\s*=?\s*(real|metal|si|cgs|electron)\b", text.split("\n", 1)[0])
    try:
        found = _ase(path, io.StringIO(text), format="lammps-data", units=units.group(1) if units else "metal")
    except StructureError:
        if re.search(r"^\s*0\s+atoms\b", text, re.MULTILINE):
            return []
        raise
    return [partial(_lammps_atoms, path, atoms, listed, labels, atom_types, units is not None) for atoms in found]


def _lammps_types(lines: list[str]) -> tuple[list[str], dict[str, str]]:
    """Of LAMMPS data the atom types in the section Masses, and what labels, or words after masses, call types."""
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
    """Types as names, by what the scene or else the file calls them; molecules as residues."""
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
    result = _from_ase(
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


def element_of_mass(mass: float) -> str:
    """The element, or heavy hydrogen, that weighs so much (u); "" if none does: several atoms as one, say."""
    from ase.data import atomic_masses, chemical_symbols

    known = {e: float(m) for e, m in zip(chemical_symbols, atomic_masses, strict=True) if e != "X"} | HEAVY_HYDROGEN
    nearest = min(known, key=lambda element: abs(known[element] - mass))
    return nearest if abs(known[nearest] - mass) <= SAME_MASS * mass else ""


# by ourselves


def _numbers(path: Path, number: int, words: list[str], what: str) -> list[float]:
    """Words of a line as numbers. Raises StructureError with the line and what should stand there."""
    try:
        return [float(word) for word in words]
    except ValueError:
        raise StructureError(str(path), [f"line {number}: expected {what}, found {' '.join(words)[:60]!r}"]) from None


def _gro(path: Path, lines: list[str]) -> list[Callable[[], Atoms]]:
    """The frames of a .gro: title, number of atoms, atoms, box; once or more."""
    while lines and not lines[-1].strip():
        lines.pop()
    frames, first = [], 0
    while first < len(lines):
        promised = lines[first + 1].strip() if first + 1 < len(lines) else ""
        if not promised.isdigit():
            raise StructureError(
                str(path), [f"line {first + 2}: expected the number of atoms, found {promised[:60]!r}"]
            )
        box = first + 2 + int(promised)
        if box >= len(lines):
            there = max(0, len(lines) - first - 3)
            raise StructureError(
                str(path), [f"line {first + 2} promises {promised} atoms and a box, {there} are there: truncated?"]
            )
        what = "the box, 3 or 9 numbers (is the number of atoms right?)"
        edges = _numbers(path, box + 1, lines[box].split(), what)
        if len(edges) not in (3, 9):
            raise StructureError(str(path), [f"line {box + 1}: expected {what}, found {lines[box].strip()!r}"])
        frames.append(partial(_gro_frame, path, lines, first, box, edges))
        first = box + 1
    return frames


def _gro_frame(path: Path, lines: list[str], first: int, box: int, edges: list[float]) -> Atoms:
    """Lines `first` to `box`. Columns are as wide as the decimal points of the first atom are apart, as in GROMACS."""
    names, residue = [], []
    position, velocity = np.zeros((box - first - 2, 3)), np.full((box - first - 2, 3), np.nan)
    points = [m.start() for m in re.finditer(r"\.", lines[first + 2][20:])] if box > first + 2 else []
    width = points[1] - points[0] if len(points) > 1 else 8
    cuts = list(pairwise(range(20, 21 + 6 * width, width)))
    for k in range(first + 2, box):
        line = lines[k]
        values = [line[a:b].strip() for a, b in cuts]
        what = f"an atom of a .gro with coordinates in columns of {width} (is the number of atoms right?)"
        position[k - first - 2] = _numbers(path, k + 1, values[:3], what)
        given = [v for v in values[3:] if v]
        if len(given) == 3:
            found = _numbers(path, k + 1, given, "three velocities")
            if not np.isfinite(found).all():
                raise StructureError(
                    str(path), [f"line {k + 1}: atom {k - first - 1} has a velocity that is not a finite number"]
                )
            velocity[k - first - 2] = found
        names.append(line[10:15].strip())
        number = line[:5].strip()
        residue.append((int(number) if number.isdecimal() else None, line[5:10].strip()))
    xx, yy, zz, xy, xz, yx, yz, zx, zy = [*edges, *[0.0] * (9 - len(edges))]
    cell = 10 * np.array([[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]])
    return Atoms(
        names,
        [""] * len(names),
        residue,
        10 * position,
        None if np.isnan(velocity).all() else 10 * velocity,
        cell,
        None,
        [],
    )


def _arc(path: Path, lines: list[str]) -> list[Callable[[], Atoms]]:
    """The frames of Tinker's .arc or .txyz: number and title, edges and angles if periodic, atoms."""
    lines = [line for line in lines if line.strip()]
    frames, first = [], 0
    while first < len(lines):
        count = lines[first].split()[0]
        if not count.isdigit():
            raise StructureError(str(path), [f"frame {len(frames) + 1}: expected the number of atoms, found {count!r}"])
        periodic = first + 1 < len(lines) and len(lines[first + 1].split()) == 6 and "." in lines[first + 1].split()[0]
        start = first + 1 + periodic
        end = start + int(count)
        if end > len(lines):
            raise StructureError(
                str(path), [f"promises {count} atoms, {max(0, len(lines) - start)} are there: truncated?"]
            )
        frames.append(partial(_arc_frame, path, lines[first + 1] if periodic else "", lines[start:end], start + 1))
        first = end
    return frames


def _arc_frame(path: Path, box: str, lines: list[str], first: int) -> Atoms:
    """The atoms from line `first` on."""
    cell = _cell(_numbers(path, first - 1, box.split(), "three edges and three angles")) if box else None
    names, position = _columns(path, lines, first, "an atom of Tinker's format: number, name, x, y, z, type, bonds")
    return Atoms(names, [""] * len(names), [()] * len(names), position, None, cell, None, [])


def _columns(path: Path, lines: list[str], first: int, what: str) -> tuple[list[str], np.ndarray]:
    """Names and positions (n, 3) in the columns after the first of lines from number `first` on."""
    rows = [line.split() for line in lines]
    position = [_numbers(path, first + k, [*row[2:5], *[""] * (5 - len(row))], what) for k, row in enumerate(rows)]
    return [row[1] for row in rows], np.reshape(position, (-1, 3))


def _cssr(path: Path, lines: list[str]) -> list[Callable[[], Atoms]]:
    """Cambridge Structure Search and Retrieval: edges, angles, how many atoms in which coordinates, title, atoms."""
    return [partial(_cssr_atoms, path, lines)]


def _cssr_atoms(path: Path, lines: list[str]) -> Atoms:
    if len(lines) < 4:
        raise StructureError(str(path), ["is too short for a .cssr: truncated?"])
    edges, angles = (re.findall(r"\d+\.\d*", line)[:3] for line in lines[:2])
    what = "the edges and angles of the cell in the first two lines"
    if len(edges) < 3 or len(angles) < 3:
        raise StructureError(str(path), [f"expected {what}"])
    if re.search(r"SPGR\s*=\s*(?!1?\s*P\s*1\s*$)\S", lines[1]):
        raise StructureError(str(path), [f"has the space group {lines[1].split('=')[-1].strip()}; only P1 is read"])
    cell = _cell(_numbers(path, 1, [*edges, *angles], what))
    head = [word for word in lines[2].split() if word.isdigit()]
    if not head or len(lines) < 4 + int(head[0]):
        raise StructureError(
            str(path), [f"line 3 promises {head[0] if head else 'no'} atoms, {len(lines) - 4} are there: truncated?"]
        )
    names, position = _columns(path, lines[4 : 4 + int(head[0])], 5, "an atom of a .cssr: number, name, x, y, z")
    if head[1:2] != ["1"]:
        position = position @ cell
    return Atoms(names, [""] * len(names), [()] * len(names), position, None, cell, None, [])


def _cell(edges_and_angles: list[float]) -> np.ndarray:
    from ase.geometry import cellpar_to_cell

    return cellpar_to_cell(edges_and_angles)


READERS = {
    ".gro": _gro,
    ".arc": _arc,
    ".txyz": _arc,
    ".cssr": _cssr,
    ".pdb": _pdb,
    ".ent": _pdb,
    ".xyz": _xyz,
    ".extxyz": _xyz,
    **dict.fromkeys(LAMMPS_DATA, _lammps),
}
