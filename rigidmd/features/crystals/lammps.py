"""Readers of LAMMPS' data files and text dumps. Atoms have types, which get names from labels,
masses or the scene.

MDAnalysis drops units, image numbers, names of types and boxes by three edges of data files, and
elements and labels of dumps. ASE refuses data files of unnamed, hybrid and sphere styles, and dumps
with labels or with elements in capitals.
"""

import re
from collections.abc import Callable, Iterable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigidmd.core.toml import parse_whole_number
from rigidmd.formats import Format, register
from rigidmd.formats.atoms import (
    Atoms,
    atom_count,
    element_of_mass,
    element_of_symbol,
    last_digit,
    names_of_types,
    numbers,
    structure_error,
    table,
    unexpected,
)
from rigidmd.formats.through_ase import ASE_VELOCITY

#: Columns of the section Atoms by atom style. Three image numbers may follow. a, b, c are columns
#: that are not used.
STYLES = {
    style: columns.split()
    for columns, styles in {
        "id type x y z": "atomic",
        "id type q x y z": "charge dpd peri",
        "id mol type x y z": "molecular angle bond",
        "id mol type q x y z": "full",
        "id type a b x y z": "sphere ellipsoid body",
        "id type q a b x y z": "electron",
        "id type q x y z a b c": "dipole",
        "id mol type a b x y z": "line tri",
        "id type mol a b x y z": "template",
    }.items()
    for style in styles.split()
}
#: Styles that a section Atoms without a style may have, if exactly one of them fits.
GUESSED = ("atomic", "charge", "molecular", "full")
#: Names of columns in a comment after Atoms.
COLUMN = {
    "atom-id": "id",
    "mol-id": "mol",
    "molecule-id": "mol",
    "molecule": "mol",
    "atom-type": "type",
    "charge": "q",
}
#: Systems of units with a length in metres. Those named lj have none.
KNOWN_UNITS = ("real", "metal", "si", "cgs", "electron", "micro", "nano")
#: In the first line of a data file, which may be any text: "units = real", "units real".
UNITS = re.compile(
    rf"\bunits(?:\s*=\s*(\w*)|\s+({'|'.join((*KNOWN_UNITS, 'lj'))})\b)", re.IGNORECASE
)
#: Columns with labels of types in a dump.
LABELS = ("typelabel", "label")
#: Columns of coordinates in a dump: wrapped, unwrapped, and both in units of the edges.
COORDINATES = (("x", "y", "z"), ("xs", "ys", "zs"), ("xu", "yu", "zu"), ("xsu", "ysu", "zsu"))


class Row(NamedTuple):
    line: int
    words: list[str]
    comment: str


def read_data(
    path: Path, lines: list[str], atom_types: dict[str, str] | None
) -> list[Callable[[], Atoms]]:
    """The structure of a data file. The first line may name the units. Real and metal differ only
    in velocities."""
    rows = head = []  # before the first section
    styles, sections = {}, {}  # the comment after the name, and the rows, of each section
    for number, line in enumerate(lines[1:], 2):
        data, _, comment = line.partition("#")
        words = data.split()
        if words and all(re.fullmatch(r"[A-Z][A-Za-z]*\d*[A-Za-z]*", word) for word in words):
            section = " ".join(words)
            styles[section], rows = comment.strip(), sections.setdefault(section, [])
        elif words:
            rows.append(Row(number, words, comment.strip()))
    counts = [row for row in head if row.words[1:] == ["atoms"]]
    if not counts:
        raise structure_error(
            path, "has no line with the number of atoms before its sections, such as '3 atoms'"
        )
    rows = sections.get("Atoms", [])
    count = atom_count(path, counts[0].line, counts[0].words[0], len(rows))
    if count != len(rows):
        raise structure_error(
            path, f"line {counts[0].line} promises {count} atoms, the section Atoms has {len(rows)}"
        )
    if rows:
        return [
            partial(
                _data_atoms, path, lines[0], head, styles.get("Atoms", ""), sections, atom_types
            )
        ]
    return []


def _data_atoms(
    path: Path, title: str, head, style: str, sections: dict[str, list[Row]], atom_types
) -> Atoms:
    """The atoms in order of their numbers. style: the comment after Atoms"""
    rows = sections["Atoms"]
    stated = UNITS.search(title)
    units = _known_units(path, 1, (stated[1] or stated[2] or "") if stated else None)
    labels = {}
    for row in sections.get("Atom Type Labels", []):
        if len(row.words) != 2:
            raise unexpected(path, row.line, "a type and its label", " ".join(row.words))
        labels[row.words[0]] = row.words[1]
    number_of = {label: number for number, label in labels.items()}
    names = dict(labels)
    mass_of = {}
    for row in sections.get("Masses", []):
        kind = number_of.get(row.words[0], row.words[0])
        [mass] = numbers(path, row.line, row.words[1:2] or [""], "a type and its mass")
        mass_of[kind] = mass * _unit(units, "mass")
        if kind not in names and len(row.comment.split()) == 1:
            names[kind] = row.comment
    declared = next((row.words[0] for row in head if row.words[1:] == ["atom", "types"]), "0")
    numbered = range(1, 1 + min(parse_whole_number(declared) or 0, len(rows)))
    column = _columns(path, style, rows, {*mass_of, *labels, *number_of, *map(str, numbered)})
    width = len(column)
    whole_columns = [column[name] for name in ("id", "mol") if name in column]
    for line, words, _ in rows:
        if len(words) < width or any(parse_whole_number(words[k]) is None for k in whole_columns):
            raise unexpected(path, line, f"an atom ({' '.join(column)})", " ".join(words))
    rows = sorted(rows, key=lambda row: parse_whole_number(row.words[column["id"]]) or 0)
    cell = _box(path, head)
    position = table(
        path, [(r.line, r.words[column["x"] : column["x"] + 3]) for r in rows], "three coordinates"
    )
    images = [row.words[width : width + 3] for row in rows]
    if cell is not None and all(len(of) == 3 for of in images):
        position += (
            table(path, [(r.line, of) for r, of in zip(rows, images, strict=True)], "three images")
            @ cell
        )
    types = [number_of.get(word := row.words[column["type"]], word) for row in rows]
    masses = None
    if mass_of:
        if lacking := sorted({kind for kind in types if kind not in mass_of}):
            raise structure_error(
                path, f"its section Masses has no mass of type {', '.join(lacking)}"
            )
        masses = np.array([mass_of[kind] for kind in types])
    elif atom_types is None and all(
        parse_whole_number(kind) is not None and kind not in names for kind in types
    ):
        hint = "name its atom types by structure.atom_types"
        raise structure_error(
            path, f"has no section Masses, and its atom types are unknown: {hint}"
        )
    element = {kind: element_of_mass(mass) for kind, mass in mass_of.items()}
    atoms = Atoms(
        names_of_types(path, types, [*mass_of], names, atom_types),
        [element.get(kind, "") for kind in types],
        _residues([row.words[column["mol"]] for row in rows] if "mol" in column else [])
        or [()] * len(rows),
        position,
        cell=cell,
        masses=masses,
        rounding=last_digit(x for r in rows for x in r.words[column["x"] : column["x"] + 3]),
    )
    moving = {row.words[0]: (row.line, row.words[1:4]) for row in sections.get("Velocities", [])}
    velocity = None
    if moving:
        if others := sorted(moving.keys() - {row.words[column["id"]] for row in rows}):
            line = moving[others[0]][0]
            raise unexpected(path, line, "the velocities of an atom of the file", others[0])
        words_of_atoms = [moving.get(row.words[column["id"]], (0, ["nan"] * 3)) for row in rows]
        velocity = table(path, words_of_atoms, "an atom and its three velocities")
    return _in_our_units(
        atoms, velocity, units, "its first line does not name its units ('units = real')"
    )


def _columns(path: Path, style: str, rows: list[Row], known: set[str]) -> dict[str, int]:
    """The columns of the atoms: by style or names after Atoms, else the only style that fits.
    Raises StructureError."""
    words = [COLUMN.get(word, word) for word in re.split(r"[\s,]+", style.lower())]
    width = len(rows[0].words)
    line = rows[0].line
    basic = STYLES["atomic"]
    if words[0] == "hybrid":
        columns = list(
            dict.fromkeys([*basic, *(name for part in words[1:] for name in STYLES.get(part, ()))])
        )
    elif words[0] in STYLES:
        columns = STYLES[words[0]]
    elif set(basic) <= set(words):
        columns = words
    else:
        fitting = [STYLES[name] for name in GUESSED if _fits(STYLES[name], rows, known)]
        if len(fitting) != 1:
            hint = f"such as 'Atoms # molecular' (known are {', '.join(STYLES)}, hybrid)"
            problem = f"line {line}: the meaning of the {width} columns of its atoms is ambiguous"
            raise structure_error(
                path, f"{problem}: write the atom style after the name of the section, {hint}"
            )
        [columns] = fitting
    if width - len(columns) not in (0, 3):
        usual = f"{len(columns)} columns ({' '.join(columns)})"
        raise structure_error(
            path, f"line {line}: an atom of style {style!r} has {usual}, found {width}"
        )
    return {name: columns.index(name) for name in columns}


def _fits(columns: list[str], rows: list[Row], known: set[str]) -> bool:
    """Whether all rows can have these columns, and three image numbers or nothing after them."""
    kind = columns.index("type")
    whole_columns = [k for k, name in enumerate(columns) if name in ("id", "mol")]
    for row in rows:
        words = row.words
        images = [word.lstrip("+-") for word in row.words[len(columns) :]]
        if len(words) < len(columns) or len(images) not in (0, 3):
            return False
        if any(
            parse_whole_number(word) is None
            for word in (*images, *(words[k] for k in whole_columns))
        ):
            return False
        if words[kind] not in known and not words[kind][0].isalpha():
            return False
    return True


def _box(path: Path, head: list[Row]) -> np.ndarray | None:
    """The cell (3, 3). None without one."""
    by_name = {
        " ".join(words[k:]): (row.line, words[:k])
        for row in head
        for words in [row.words]
        for k in (2, 3, 4)
    }
    if "avec" in by_name:
        edges = [by_name.get(name, (1, [])) for name in ("avec", "bvec", "cvec")]
        return table(path, edges, "three components of an edge")
    lines = [f"{x}lo {x}hi" for x in "xyz"]
    if lacking := [line for line in lines if line not in by_name]:
        if any(word.endswith(("lo", "hi")) for row in head for word in row.words):
            missing = f"a line 'LOW HIGH {lacking[0]}' is missing before the sections"
            raise structure_error(path, f"the bounds of its box are incomplete: {missing}")
        return None
    low, high = table(path, [by_name[line] for line in lines], "two bounds of the box").T
    cell = np.diag(high - low)
    if "xy xz yz" in by_name:
        cell[1, 0], cell[2, 0], cell[2, 1] = numbers(
            path, *by_name["xy xz yz"], "three tilts of the box"
        )
    return cell


def _residues(numbers_of: Iterable[str]) -> list[tuple]:
    """Residues from molecule numbers. The result is empty if all numbers are 0, which stands for no
    molecules."""
    numbers_read = [parse_whole_number(number) for number in numbers_of]
    return [(number, "") for number in numbers_read] if any(numbers_read) else []


def _known_units(path: Path, line: int, name: str | None) -> str:
    """Units that a line names, in lower case. "" if it names none. Raises StructureError."""
    if name is None or name.lower() in KNOWN_UNITS:
        return (name or "").lower()
    if name.lower() == "lj":
        advice = "lengths in units of sigma, which the file does not have: convert it to real"
    else:
        advice = f"expected {', '.join(KNOWN_UNITS)}"
    raise structure_error(path, f"line {line}: its units are {name[:20]!r}, {advice}")


def _unit(units: str, quantity: str) -> float:
    """A unit of LAMMPS in Å, Å/ps or u. 1 if the file does not name its units."""
    from ase.calculators.lammps import convert

    factor = ASE_VELOCITY if quantity == "velocity" else 1.0
    return factor * convert(1.0, quantity, units, "ASE") if units else 1.0


def _in_our_units(atoms: Atoms, velocity: np.ndarray | None, units: str, unknown: str) -> Atoms:
    """Atoms in Å and ps. If the file names no units, lengths are in Å and velocities are not
    used."""
    if not units:
        unit_notes = [] if velocity is None else [f"{unknown}: its velocities are not used"]
        return atoms._replace(notes=[*atoms.notes, *unit_notes])
    length = _unit(units, "distance")
    return atoms._replace(
        position=atoms.position * length,
        cell=None if atoms.cell is None else atoms.cell * length,
        rounding=atoms.rounding * length,
        velocity=None
        if velocity is None
        else np.where(np.isfinite(velocity), velocity * _unit(units, "velocity"), np.nan),
    )


def read_dump(
    path: Path, lines: list[str], atom_types: dict[str, str] | None
) -> list[Callable[[], Atoms]]:
    """Readers of the frames of a dump."""
    named = {
        lines[k + 1].strip(): k + 2
        for k, line in enumerate(lines[:-1])
        if line.startswith("ITEM: UNITS")
    }
    if len(named) > 1:
        raise structure_error(path, f"names several units, {', '.join(named)}: keep one")
    units = next((_known_units(path, line, name) for name, line in named.items()), "")
    starts = [k for k, line in enumerate(lines) if line.startswith("ITEM: TIMESTEP")]
    parts = pairwise([*starts, len(lines)])
    return [
        partial(_dump_frame, path, lines[first:last], first, units, atom_types)
        for first, last in parts
    ]


def _dump_frame(path: Path, lines: list[str], first: int, units: str, atom_types) -> Atoms:
    """The frame in the lines after line number `first`."""
    at = {
        " ".join(line.split()[1:3]): k for k, line in enumerate(lines) if line.startswith("ITEM: ")
    }
    atoms = next((k for k, line in enumerate(lines) if line.startswith("ITEM: ATOMS")), None)
    if (
        "NUMBER OF" not in at
        or "BOX BOUNDS" not in at
        or atoms is None
        or max(at.values()) + 1 >= len(lines)
    ):
        missing = "expected ITEM: NUMBER OF ATOMS, BOX BOUNDS and ATOMS after it: truncated?"
        raise structure_error(path, f"line {first + 1}: {missing}")
    line = at["NUMBER OF"] + 1
    count = atom_count(path, first + line + 1, lines[line].strip(), len(lines) - atoms - 1)
    listed = lines[atoms].split()[2:]
    if twice := sorted({name for name in listed if listed.count(name) > 1}):
        message = f"line {first + atoms + 1}: names the column {', '.join(twice)} twice"
        raise structure_error(path, f"{message}: which one counts is unknown")
    columns = {name: k for k, name in enumerate(listed)}
    rows = [(first + k + 1, lines[k].split()) for k in range(atoms + 1, atoms + 1 + count)]
    if short := [row for row in rows if len(row[1]) < len(columns)]:
        line, words = short[0]
        raise unexpected(
            path, line, f"{len(columns)} columns ({' '.join(columns)})", " ".join(words)
        )

    def of(*names: str) -> np.ndarray:
        values = [(number, [words[columns[name]] for name in names]) for number, words in rows]
        return table(path, values, " ".join(names))

    def texts(name: str) -> list[str]:
        return [words[columns[name]] for _, words in rows]

    if "id" in columns:
        rows.sort(key=lambda row: parse_whole_number(row[1][columns["id"]]) or 0)
    begin = at["BOX BOUNDS"]
    bounds = [(first + k + 1, lines[k].split()) for k in range(begin + 1, begin + 4)]
    low, cell = dump_box(path, lines[begin].split()[3:], bounds)
    coordinates = next((names for names in COORDINATES if set(names) <= set(columns)), None)
    if coordinates is None:
        raise structure_error(
            path, f"line {first + atoms + 1}: has no columns of coordinates, x y z or xs ys zs"
        )
    position = of(*coordinates)
    if coordinates[0].startswith("xs"):
        position = low + position @ cell
    flags = re.findall(r"(?<=\s)[pfsm]{2}(?=\s|$)", lines[begin])
    notes = []
    if not all("p" in flag for flag in flags):
        axes = ", ".join(x for x, flag in zip("abc", flags, strict=False) if "p" in flag)
        notes = [f"its cell is periodic along {axes} only and is not used"] if axes else []
        cell = None
    masses = of("mass")[:, 0] * _unit(units, "mass") if "mass" in columns else None
    columns_of_names = {
        name: texts(name) for name in ("type", "element", *LABELS) if name in columns
    }
    names, elements = _dump_names(path, first + atoms + 1, columns_of_names, masses, atom_types)
    frame_atoms = Atoms(
        names,
        elements,
        _residues(texts("mol") if "mol" in columns else []) or [()] * count,
        position,
        None,
        cell,
        masses,
        notes,
    )
    velocity = of("vx", "vy", "vz") if {"vx", "vy", "vz"} <= set(columns) else None
    return _in_our_units(
        frame_atoms,
        velocity,
        units,
        "it does not name its units (dump_modify units yes)",
    )


def _dump_names(
    path: Path,
    line: int,
    columns: dict[str, list[str]],
    masses: np.ndarray | None,
    atom_types: dict[str, str] | None,
) -> tuple[list[str], list[str]]:
    """Names and elements of the atoms in a dump, from its type, label and element columns, named in
    a line."""
    named = columns.get("element", [])
    labelled = next((columns[name] for name in LABELS if name in columns), named)
    types = columns.get("type", labelled)
    if not types and masses is None:
        expected = f"type, {', '.join(LABELS)}, element or mass"
        raise structure_error(path, f"line {line}: has no column that names its atoms: {expected}")
    if atom_types is not None:
        labels = dict(zip(types, labelled, strict=False))
        return names_of_types(path, types, [], labels, atom_types), [""] * len(types)
    elements = [element_of_symbol(e) for e in named]
    if not elements and masses is not None:
        element = {mass: element_of_mass(mass) for mass in set(masses.tolist())}
        elements = [element[mass] for mass in masses.tolist()]
    names = labelled or types or [""] * len(elements)
    if not elements and all(parse_whole_number(name) is not None for name in names):
        hint = 'name the types by structure.atom_types, { 1 = "O" }'
        raise structure_error(path, f"has only types of atoms, no elements or masses: {hint}")
    return names, elements or [""] * len(names)


def dump_box(
    path: Path, kinds: list[str], rows: list[tuple[int, list[str]]]
) -> tuple[np.ndarray, np.ndarray]:
    """Origin (3,) and cell (3, 3) of a dump, whose bounds enclose the cell. kinds : the words after
    BOX BOUNDS"""
    bounds = table(path, rows, "the bounds of the box")
    general = kinds[:1] == ["abc"]
    if bounds.shape not in ([(3, 4)] if general else [(3, 2), (3, 3)]):
        raise unexpected(path, rows[0][0], "the bounds of the box along x", " ".join(rows[0][1]))
    if general:
        return bounds[:, 3], bounds[:, :3]
    xy, xz, yz = bounds[:, 2] if bounds.shape[1] > 2 else np.zeros(3)
    low = bounds[:, 0] - [min(0.0, xy, xz, xy + xz), min(0.0, yz), 0.0]
    high = bounds[:, 1] - [max(0.0, xy, xz, xy + xz), max(0.0, yz), 0.0]
    cell = np.diag(high - low)
    cell[1, 0], cell[2, 0], cell[2, 1] = xy, xz, yz
    return low, cell


register(
    Format(
        (".data", ".lmp", ".lammps"),
        "data files of LAMMPS (.data)",
        read=read_data,
        has_types=True,
        content=re.compile(r"^[ \t]*\d+[ \t]+atoms[ \t]*(#.*)?$", re.MULTILINE),
    )
)
register(
    Format(
        (),
        "dumps of LAMMPS",
        read=read_dump,
        has_types=True,
        content=re.compile(r"\A\s*ITEM: (TIMESTEP|UNITS|TIME)\b"),
    )
)
