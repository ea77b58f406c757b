"""Readers of the formats that ASE does not read well enough.

These are .gro (ASE supports neither more digits, nor several frames, nor velocities of some atoms only), .pdb (ASE
supports neither numbers wider than their columns nor boxes that are none), Tinker's .arc and .txyz (ASE has no reader,
MDAnalysis reads in single precision) and .cssr (neither has a reader).
"""

import contextlib
import re
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from rigidmd.core.toml import whole_number
from rigidmd.errors import StructureError
from rigidmd.io.atoms import HEAVY_HYDROGEN, Atoms, is_element


def promised_atoms(path: Path, line: int, text: str, there: int) -> int:
    """The number of atoms that a line promises, at most as many as there are. Raises StructureError."""
    count = whole_number(text)
    if count is None:
        raise StructureError(str(path), [f"line {line}: expected the number of atoms, found {text[:60]!r}"])
    if count > there:
        raise StructureError(str(path), [f"line {line} promises {count} atoms, {max(0, there)} are there: truncated?"])
    return count


def without_fortran(word: str) -> str:
    """A number with the exponent of Fortran's double precision, 1.5D+00, as other languages write it."""
    return re.sub(r"(?<=[\d.])[dD](?=[-+]?\d+$)", "e", word)


def numbers(path: Path, line: int, words: list[str], what: str) -> list[float]:
    """Words of a line as numbers. Raises StructureError with the line and what was expected."""
    try:
        return [float(without_fortran(word)) for word in words]
    except ValueError:
        raise StructureError(str(path), [f"line {line}: expected {what}, found {' '.join(words)[:60]!r}"]) from None


def table(path: Path, rows: list[tuple[int, list[str]]], what: str) -> np.ndarray:
    """Words of lines, each with its number, as numbers (n, k). Raises StructureError as `numbers` does."""
    try:
        return np.array([words for _, words in rows], float) if rows else np.zeros((0, 3))
    except ValueError:
        found = [numbers(path, line, words, what) for line, words in rows]
        for (line, words), values in zip(rows, found, strict=True):
            if len(values) != len(found[0]) or not values:
                told = f"line {line}: expected {what}, found {' '.join(words)[:60]!r}"
                raise StructureError(str(path), [told]) from None
        return np.array(found)


def read_gro(path: Path, lines: list[str]) -> list[Callable[[], Atoms]]:
    """The frames of a .gro: title, number of atoms, atoms, box; once or more."""
    while lines and not lines[-1].strip():
        lines.pop()
    frames, first = [], 0
    while first < len(lines):
        promised = lines[first + 1].strip() if first + 1 < len(lines) else ""
        if not lines[first].strip() and whole_number(promised) is None:  # an empty line, not an empty title
            first += 1
            continue
        count = whole_number(promised)
        if count is None:
            raise StructureError(
                str(path), [f"line {first + 2}: expected the number of atoms, found {promised[:60]!r}"]
            )
        box = first + 2 + count
        if box >= len(lines):
            there = max(0, len(lines) - first - 3)
            raise StructureError(
                str(path), [f"line {first + 2} promises {count} atoms and a box, {there} are there: truncated?"]
            )
        what = "the box, 3 or 9 numbers (is the number of atoms right?)"
        edges = numbers(path, box + 1, lines[box].split(), what)
        if len(edges) not in (3, 9):
            raise StructureError(str(path), [f"line {box + 1}: expected {what}, found {lines[box].strip()!r}"])
        frames.append(partial(_gro_frame, path, lines, first, box, edges))
        first = box + 1
    return frames


def _gro_frame(path: Path, lines: list[str], first: int, box: int, edges: list[float]) -> Atoms:
    """The frame in lines `first` to `box`. Column width is the distance between decimal points, as in GROMACS."""
    names, residue = [], []
    position, velocity = np.zeros((box - first - 2, 3)), np.full((box - first - 2, 3), np.nan)
    points = [m.start() for m in re.finditer(r"\.", lines[first + 2][20:])] if box > first + 2 else []
    width = points[1] - points[0] if len(points) > 1 else 8
    cuts = list(pairwise(range(20, 21 + 6 * width, width)))
    for k in range(first + 2, box):
        line = lines[k]
        values = [line[a:b].strip() for a, b in cuts]
        what = f"an atom of a .gro with coordinates in columns of {width} (is the number of atoms right?)"
        position[k - first - 2] = numbers(path, k + 1, values[:3], what)
        given = [v for v in values[3:] if v]
        if len(given) == 3:
            found = numbers(path, k + 1, given, "three velocities")
            if not np.isfinite(found).all():
                raise StructureError(
                    str(path), [f"line {k + 1}: atom {k - first - 1} has a velocity that is not a finite number"]
                )
            velocity[k - first - 2] = found
        names.append(line[10:15].strip())
        residue.append((whole_number(line[:5].strip()), line[5:10].strip()))
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


def read_arc(path: Path, lines: list[str]) -> list[Callable[[], Atoms]]:
    """The frames of Tinker's .arc or .txyz: number and title, edges and angles if periodic, atoms."""
    rows = [(k, line.split()) for k, line in enumerate(lines, 1) if line.strip()]
    frames, first = [], 0
    while first < len(rows):
        line, words = rows[first]
        periodic = first + 1 < len(rows) and len(rows[first + 1][1]) == 6 and "." in rows[first + 1][1][0]
        start = first + 1 + periodic
        end = start + promised_atoms(path, line, words[0], len(rows) - start)
        frames.append(partial(_arc_frame, path, rows[first + 1 : start], rows[start:end]))
        first = end
    return frames


def _arc_frame(path: Path, box: list[tuple[int, list[str]]], rows: list[tuple[int, list[str]]]) -> Atoms:
    cell = _cell(path, numbers(path, *box[0], "three edges and three angles")) if box else None
    return _listed(path, rows, "an atom of Tinker's format: number, name, x, y, z, type, bonds", cell)


def _listed(path: Path, rows: list[tuple[int, list[str]]], what: str, cell: np.ndarray | None, unit=None) -> Atoms:
    """Atoms with number, name and position in the first columns; positions in `unit`, rows (3, 3), where given."""
    position = table(path, [(k, words[2:5] if len(words) > 4 else [" ".join(words)]) for k, words in rows], what)
    position = position if unit is None else position @ unit
    names = [words[1] for _, words in rows]
    return Atoms(names, [""] * len(names), [()] * len(names), position.reshape(-1, 3), None, cell, None, [])


def read_cssr(path: Path, lines: list[str]) -> list[Callable[[], Atoms]]:
    """Cambridge Structure Search and Retrieval: edges, angles, number of atoms, kind of coordinates, title, atoms."""
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
    cell = _cell(path, numbers(path, 1, [*edges, *angles], what))
    head = [word for word in lines[2].split() if whole_number(word) is not None]
    count = promised_atoms(path, 3, head[0] if head else lines[2].strip(), len(lines) - 4)
    rows = [(k, line.split()) for k, line in enumerate(lines[4 : 4 + count], 5)]
    return _listed(path, rows, "an atom of a .cssr: number, name, x, y, z", cell, None if head[1:2] == ["1"] else cell)


#: Columns of the edges and angles in CRYST1, and coordinates as the format has them, in columns or beyond them.
CRYST1 = (6, 15, 24, 33, 40, 47, 54)
IN_COLUMNS = re.compile(r" *-?\d+\.\d{3}")
#: Before those that are wider may be the last digits of a residue's number.
BEYOND = re.compile(r"\w{0,3}\s" + 3 * r"\s*(-?\d+\.\d{3})")
FREE = re.compile(r"\w{0,3}" + 3 * r"\s+([-+]?\d*\.\d*(?:[eEdD][-+]?\d+)?)" + r"(?=\s|$)")


def read_pdb(path: Path, lines: list[str]) -> list[Callable[[], Atoms]]:
    """The models of a .pdb, each with the last CRYST1 before it."""
    models, body, cell, notes = [], [], None, []
    ends = next((line for line in reversed(lines) if line.strip()), "")
    cut = ["it ends with an atom, without END: is it truncated?"] if ends.startswith(("ATOM", "HETATM")) else []
    for number, line in enumerate([*lines, "END"], 1):
        if line.startswith("CRYST1"):
            cell, notes = _cryst1(number, line)
        elif line.startswith(("ATOM", "HETATM")):
            body.append((number, line))
        elif line.startswith("END") and body:
            models.append(partial(_pdb_model, path, body, cell, [*notes, *(cut if number > len(lines) else [])]))
            body = []
    return models


def _cryst1(line: int, text: str) -> tuple[np.ndarray | None, list[str]]:
    """The cell of a CRYST1 in words or in columns. Of one that is no cell, of zeros for one, None and a note."""
    for words in (text[6:].split()[:6], [text[a:b] for a, b in pairwise(CRYST1)]):
        with contextlib.suppress(ValueError):
            values = [float(word) for word in words]
            if len(values) == 6:
                cell = _cell_of(values)
                told = " ".join(f"{x:g}" for x in values)
                return cell, [] if cell is not None else [f"line {line}: CRYST1 of {told} is no box"]
    return None, [f"line {line}: CRYST1 needs three edges and three angles, found {text[6:].strip()!r}"]


def _pdb_model(path: Path, body: list[tuple[int, str]], cell: np.ndarray | None, notes: list[str]) -> Atoms:
    """One model. Residues are numbered anew: their numbers wrap or run out."""
    names, elements, residue, position, places = [], [], [], [], set()
    count, last = 0, None
    for number, full in body:
        line, end, coordinates = _pdb_columns(path, number, full)
        position.append(coordinates)
        symbol = full[end + 22 : end + 24].strip().capitalize()
        names.append(line[12:16].strip())
        elements.append(symbol if is_element(symbol) or symbol in HEAVY_HYDROGEN else "")
        places.add(line[16:17].strip())
        if (here := line[17:28]) != last:  # name, chain, number and insertion code
            count, last = count + 1, here
        digits = re.match(r" *(\d+)", line[22:30])
        residue.append((int(digits[1]) if digits else None, line[17:21].strip(), count))
    if len(places := places - {""}) > 1:
        raise StructureError(str(path), [f"has alternate locations {', '.join(sorted(places))}; keep one of them"])
    if count == 1 and not residue[0][1]:
        residue = [()] * len(names)
    return Atoms(names, elements, residue, np.array(position), None, cell, None, notes)


def _pdb_columns(path: Path, number: int, line: str) -> tuple[str, int, list[float]]:
    """A line of an atom with what precedes its coordinates in the columns of the format, where the coordinates end in
    the given line, and the coordinates. Wide numbers move what follows them."""
    fields = [line[a : a + 8] for a in (30, 38, 46)]
    if all(map(IN_COLUMNS.fullmatch, fields)):
        return line, 54, [float(field) for field in fields]
    serial = re.match(r"(?:ATOM  |HETATM)(\d*)", line)
    moved = max(0, len(serial[1]) - 5) if serial else 0
    straight = line[:11] + line[11 + moved :]
    found = BEYOND.match(line, 26 + moved)
    joined = any(not line[a - 1 : a].isspace() and line[a : a + 1].isalnum() for a in (30, 38, 46, 54))
    if not found and not joined:
        with contextlib.suppress(ValueError):
            return line, 54, [float(field) for field in fields]
    if not (found := found or FREE.match(line, 26 + moved)):
        told = f"line {number}: expected an atom of a .pdb with coordinates in columns 31 to 54, found {line[26:60]!r}"
        raise StructureError(str(path), [told])
    return straight, found.end(), numbers(path, number, list(found.groups()), "three coordinates")


def _cell_of(edges_and_angles: list[float]) -> np.ndarray | None:
    """The cell (3, 3) with these edges and angles; None where there is none."""
    from ase.geometry import cellpar_to_cell

    edges, angles = np.array(edges_and_angles).reshape(2, 3)
    if np.isfinite(edges).all() and (edges > 0).all() and (angles > 0).all() and (angles < 180).all():
        with contextlib.suppress(AssertionError):  # of ASE, where three edges cannot form the angles
            return cellpar_to_cell([*edges, *angles])
    return None


def _cell(path: Path, edges_and_angles: list[float]) -> np.ndarray:
    """The same, where there must be one. Raises StructureError."""
    if (cell := _cell_of(edges_and_angles)) is not None:
        return cell
    told = " ".join(f"{x:g}" for x in edges_and_angles)
    raise StructureError(str(path), [f"no cell has its edges and angles, {told}"])
