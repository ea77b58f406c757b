"""PDB. Neither ASE, gemmi nor MDAnalysis reads numbers wider than their columns: gemmi takes other
numbers for them without a message. ASE refuses names that start with no element and a CRYST1 that
stands for no cell."""

import contextlib
import re
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from rigidmd.formats import Encode, Format, Placed, Topology, register
from rigidmd.formats.atoms import (
    Atoms,
    Frame,
    element_of_symbol,
    numbers,
    structure_error,
    unexpected,
)
from rigidmd.formats.cells import cell_of
from rigidmd.formats.through_mdanalysis import FrameFiles, dimensions

#: Columns of the edges and angles in CRYST1.
CRYST1 = (6, 15, 24, 33, 40, 47, 54)
#: One more than the largest numbers in their columns.
MOST_ATOMS, MOST_RESIDUES = 100_000, 10_000
BONDS_PER_LINE, MOST_LISTED = 4, 6  # the latter in a message
COORDINATES_END, LAST_DIGIT = 54, 1e-3  # column; Å
SPACE_GROUP = slice(55, 66)
#: A coordinate in its columns, and three coordinates beyond them, which may follow the last digits
#: of a residue number.
IN_COLUMNS = re.compile(r" *-?\d+\.\d{3}")
BEYOND = re.compile(r"\w{0,3}\s" + 3 * r"\s*(-?\d+\.\d{3})")
FREE = re.compile(r"\w{0,3}" + 3 * r"\s+([-+]?\d*\.\d*(?:[eEdD][-+]?\d+)?)" + r"(?=\s|$)")


def read_pdb(path: Path, lines: list[str]) -> list[Callable[[], Atoms]]:
    """The models of a .pdb, each with the last CRYST1 before it."""
    models = []
    body = []
    cell = None
    notes = []
    ends = next((line for line in reversed(lines) if line.strip()), "")
    if ends.startswith(("ATOM", "HETATM")):
        cut = ["it ends with an atom, without END: is it truncated?"]
    else:
        cut = []
    for number, line in enumerate([*lines, "END"], 1):
        if line.startswith("CRYST1"):
            cell, notes = _cryst1(number, line)
        elif line.startswith(("ATOM", "HETATM")):
            body.append((number, line))
        elif line.startswith("END") and body:
            models.append(
                partial(
                    _pdb_model, path, body, cell, [*notes, *(cut if number > len(lines) else [])]
                )
            )
            body = []
    return models


def _cryst1(line: int, text: str) -> tuple[np.ndarray | None, list[str]]:
    """The cell of a CRYST1, separated by spaces or in columns. None and a note if it stands for no
    cell (zeros)."""
    for words in (text[6:].split()[:6], [text[a:b] for a, b in pairwise(CRYST1)]):
        with contextlib.suppress(ValueError):
            values = [float(word) for word in words]
            if len(values) == 6:
                cell = cell_of(values)
                edges = " ".join(f"{x:g}" for x in values)
                if cell is None:
                    return None, [f"line {line}: CRYST1 of {edges} defines no cell"]
                return cell, _space_group_note(line, text)
    return None, [
        f"line {line}: CRYST1 needs three edges and three angles, found {text[6:].strip()!r}"
    ]


def _space_group_note(line: int, text: str) -> list[str]:
    """A note if CRYST1 names a space group with further symmetry operations, which are not
    applied."""
    name = text[SPACE_GROUP].strip()
    if not name or name.replace(" ", "") in ("P1", "1"):
        return []
    return [
        f"line {line}: the space group {name} is not applied: its atoms were taken as all atoms of"
        " the cell"
    ]


def _pdb_model(
    path: Path, body: list[tuple[int, str]], cell: np.ndarray | None, notes: list[str]
) -> Atoms:
    """One model. Residues are renumbered, because their numbers may wrap or be missing."""
    names = []
    elements = []
    residue = []
    position = []
    locations = set()
    count = 0
    last = None
    is_in_columns = True
    unknown: set[str] = set()
    for number, full in body:
        line, end, coordinates = _pdb_columns(path, number, full)
        position.append(coordinates)
        is_in_columns &= end == COORDINATES_END
        # in capitals: CO is cobalt
        symbol = full[end + 22 : end + 24].strip()
        elements.append(element_of_symbol(symbol).capitalize())
        if symbol and not elements[-1]:
            unknown.add(symbol)
        names.append(line[12:16].strip())
        locations.add(line[16:17].strip())
        if (here := line[17:28]) != last:  # name, chain, number and insertion code
            count = count + 1
            last = here
        digits = re.match(r" *(\d+)", line[22:30])
        residue.append((int(digits[1]) if digits else None, line[17:21].strip(), count))
    if len(locations := locations - {""}) > 1:
        raise structure_error(
            path, f"has alternate locations {', '.join(sorted(locations))}. Keep one of them"
        )
    if unknown:
        where = (
            f"in columns 77 and 78, {', '.join(sorted(unknown)[:MOST_LISTED])}, are not elements"
        )
        notes = [*notes, f"symbols {where}: the names of atoms were used"]
    if count == 1 and not residue[0][1]:
        residue = [()] * len(names)
    return Atoms(
        names,
        elements,
        residue,
        np.array(position),
        cell=cell,
        notes=notes,
        rounding=LAST_DIGIT if is_in_columns else 0.0,
    )


def _pdb_columns(path: Path, number: int, line: str) -> tuple[str, int, list[float]]:
    """An atom line with names in the columns of the format, the end of the coordinates in the given
    line, and the coordinates. Numbers wider than their columns shift the rest."""
    fields = [line[a : a + 8] for a in (30, 38, 46)]
    if all(map(IN_COLUMNS.fullmatch, fields)):
        return line, COORDINATES_END, [float(field) for field in fields]
    serial = re.match(r"(?:ATOM  |HETATM)(\d*)", line)
    moved = max(0, len(serial[1]) - 5) if serial else 0
    straight = line[:11] + line[11 + moved :]
    coordinates = BEYOND.match(line, 26 + moved)
    joined = any(
        not line[a - 1 : a].isspace() and line[a : a + 1].isalnum() for a in (30, 38, 46, 54)
    )
    if not coordinates and not joined:
        with contextlib.suppress(ValueError):
            return line, COORDINATES_END, [float(field) for field in fields]
    if not (coordinates := coordinates or FREE.match(line, 26 + moved)):
        raise unexpected(
            path, number, "an atom of a .pdb with coordinates in columns 31 to 54", line[26:60]
        )
    return (
        straight,
        coordinates.end(),
        numbers(path, number, list(coordinates.groups()), "three coordinates"),
    )


def _box_lines(cell: np.ndarray | None) -> list[str]:
    """CRYST1 of a cell (3, 3). Edges of 100,000 Å and more have fewer decimals, to stay in their
    columns."""
    if (box := dimensions(cell)) is None:
        return []
    edges = "".join(f"{edge:9.3f}"[:9] for edge in box[:3])
    return [f"CRYST1{edges}{''.join(f'{angle:7.2f}' for angle in box[3:])} P 1           1"]


def encoder(system: Placed, interval: float, velocities: bool) -> Encode:
    """Models, each with its time in a remark and its box before it. Bonds are in the topology."""
    files = FrameFiles(
        system, velocities=velocities, name="PDB", options={"multiframe": True, "bonds": None}
    )

    def encode(frame: Frame, k: int) -> bytes:
        def write(writer, atoms):
            writer.REMARK(f"TIME {frame.time:.6f} PS")
            writer.write(atoms)

        # without END, which readers count as a further frame
        lines = (
            files.content(frame, write, start=k).removesuffix(b"END\n").splitlines(keepends=True)
        )
        model = next(i for i, line in enumerate(lines) if line.startswith(b"MODEL "))
        head = [line for line in lines[: 1 if k else model] if not line.startswith(b"CRYST1")]
        box = [f"{line}\n".encode() for line in _box_lines(frame.cell)]
        return b"".join([*head, *box, *lines[model:]])

    return encode


def pdb_text(system: Topology) -> str:
    """One model with its bonds. Numbers wider than their columns lose their leading digits. Atoms
    from 100,000 on have no bonds."""
    lines = ["TITLE     Written by rigidmd", *_box_lines(system.cell)]
    rows = zip(
        system.names,
        system.elements,
        system.residues,
        system.residue_names,
        system.positions.tolist(),
        strict=True,
    )
    for k, (name, element, residue, residue_name, position) in enumerate(rows, 1):
        # a symbol of one letter stands in the second column of the name
        aligned = f" {name}" if len(name) < 4 and len(element) < 2 else name
        x, y, z = position
        lines.append(
            f"ATOM  {k % MOST_ATOMS:5d} {aligned:<4.4s} {residue_name:<4.4s}X"
            f"{residue % MOST_RESIDUES:4d}    {x:8.3f}{y:8.3f}{z:8.3f}  1.00  0.00"
            f"          {element.upper():>2s}"
        )
    lines += [f"CONECT{''.join(f'{atom:5d}' for atom in atoms)}" for atoms in _conect(system)]
    return "".join(f"{line}\n" for line in (*lines, "END"))


def _conect(system: Topology) -> Iterator[list[int]]:
    """Numbers of an atom and of at most four atoms that are joined to it, for each line."""
    joined: dict[int, list[int]] = {}
    for one, other in 1 + system.bonds():
        joined.setdefault(int(one), []).append(int(other))
        joined.setdefault(int(other), []).append(int(one))
    for atom in sorted(joined):
        others = sorted(other for other in joined[atom] if max(atom, other) < MOST_ATOMS)
        for first in range(0, len(others), BONDS_PER_LINE):
            yield [atom, *others[first : first + BONDS_PER_LINE]]


register(
    Format(
        (".pdb", ".ent"),
        read=read_pdb,
        encoder=encoder,
        times=re.compile(rb"^REMARK +()TIME +(\S+) PS"),
        content=re.compile(r"^(ATOM  |HETATM).{24}( *-?\d+\.\d{3}){3}", re.MULTILINE),
        topology=pdb_text,
        limits=(-999.99, 9999.99),  # columns of eight
    )
)
