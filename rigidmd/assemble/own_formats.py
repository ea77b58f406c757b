"""Readers of the formats that ASE does not read well enough.

These are .gro (ASE supports neither more digits, nor several frames, nor velocities of some atoms only), Tinker's .arc
and .txyz (ASE has no reader, MDAnalysis reads in single precision) and .cssr (neither has a reader).
"""

import contextlib
import re
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from rigidmd.assemble.atoms import Atoms
from rigidmd.core.toml_text import whole_number
from rigidmd.errors import StructureError


def promised_atoms(path: Path, line: int, text: str, there: int) -> int:
    """The number of atoms that a line promises, at most as many as there are. Raises StructureError."""
    count = whole_number(text)
    if count is None:
        raise StructureError(str(path), [f"line {line}: expected the number of atoms, found {text[:60]!r}"])
    if count > there:
        raise StructureError(str(path), [f"line {line} promises {count} atoms, {max(0, there)} are there: truncated?"])
    return count


def _numbers(path: Path, number: int, words: list[str], what: str) -> list[float]:
    """Words of a line as numbers. Raises StructureError with the line and what was expected."""
    try:
        return [float(word) for word in words]
    except ValueError:
        raise StructureError(str(path), [f"line {number}: expected {what}, found {' '.join(words)[:60]!r}"]) from None


def read_gro(path: Path, lines: list[str]) -> list[Callable[[], Atoms]]:
    """The frames of a .gro: title, number of atoms, atoms, box; once or more."""
    while lines and not lines[-1].strip():
        lines.pop()
    frames, first = [], 0
    while first < len(lines):
        promised = lines[first + 1].strip() if first + 1 < len(lines) else ""
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
        edges = _numbers(path, box + 1, lines[box].split(), what)
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
    lines = [line for line in lines if line.strip()]
    frames, first = [], 0
    while first < len(lines):
        words = lines[first].split()
        periodic = first + 1 < len(lines) and len(lines[first + 1].split()) == 6 and "." in lines[first + 1].split()[0]
        start = first + 1 + periodic
        end = start + promised_atoms(path, first + 1, words[0], len(lines) - start)
        frames.append(partial(_arc_frame, path, lines[first + 1] if periodic else "", lines[start:end], start + 1))
        first = end
    return frames


def _arc_frame(path: Path, box: str, lines: list[str], first: int) -> Atoms:
    """The atoms from line `first` on."""
    cell = _cell(path, _numbers(path, first - 1, box.split(), "three edges and three angles")) if box else None
    names, position = _columns(path, lines, first, "an atom of Tinker's format: number, name, x, y, z, type, bonds")
    return Atoms(names, [""] * len(names), [()] * len(names), position, None, cell, None, [])


def _columns(path: Path, lines: list[str], first: int, what: str) -> tuple[list[str], np.ndarray]:
    """Names and positions (n, 3) in the columns after the first of lines from number `first` on."""
    rows = [line.split() for line in lines]
    position = [_numbers(path, first + k, [*row[2:5], *[""] * (5 - len(row))], what) for k, row in enumerate(rows)]
    return [row[1] for row in rows], np.reshape(position, (-1, 3))


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
    cell = _cell(path, _numbers(path, 1, [*edges, *angles], what))
    head = [word for word in lines[2].split() if whole_number(word) is not None]
    count = promised_atoms(path, 3, head[0] if head else lines[2].strip(), len(lines) - 4)
    names, position = _columns(path, lines[4 : 4 + count], 5, "an atom of a .cssr: number, name, x, y, z")
    if head[1:2] != ["1"]:
        position = position @ cell
    return Atoms(names, [""] * len(names), [()] * len(names), position, None, cell, None, [])


def _cell(path: Path, edges_and_angles: list[float]) -> np.ndarray:
    from ase.geometry import cellpar_to_cell

    edges, angles = np.array(edges_and_angles).reshape(2, 3)
    if (edges > 0).all() and (angles > 0).all() and (angles < 180).all():
        with contextlib.suppress(AssertionError):  # of ASE, where three edges cannot form the angles
            return cellpar_to_cell([*edges, *angles])
    told = " ".join(f"{x:g}" for x in edges_and_angles)
    raise StructureError(str(path), [f"no cell has its edges and angles, {told}"])
