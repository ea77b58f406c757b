"""Readers of Tinker's .arc and .txyz (MDAnalysis reads them in single precision, ASE does not) and of .cssr."""

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from rigidmd.core.toml import parse_whole_number
from rigidmd.io.atoms import Atoms, structure_error
from rigidmd.io.formats.text import atom_count, numbers, required_cell, table


def read_arc(path: Path, lines: list[str]) -> list[Callable[[], Atoms]]:
    """The frames of Tinker's .arc or .txyz: number and title, edges and angles if periodic, atoms."""
    rows = [(k, line.split()) for k, line in enumerate(lines, 1) if line.strip()]
    frames, first = [], 0
    while first < len(rows):
        line, words = rows[first]
        periodic = first + 1 < len(rows) and len(rows[first + 1][1]) == 6 and "." in rows[first + 1][1][0]
        start = first + 1 + periodic
        end = start + atom_count(path, line, words[0], len(rows) - start)
        frames.append(partial(_arc_frame, path, rows[first + 1 : start], rows[start:end]))
        first = end
    return frames


def _arc_frame(path: Path, box: list[tuple[int, list[str]]], rows: list[tuple[int, list[str]]]) -> Atoms:
    cell = required_cell(path, numbers(path, *box[0], "three edges and three angles")) if box else None
    return _listed(path, rows, "an atom of Tinker's format: number, name, x, y, z, type, bonds", cell)


def _listed(path: Path, rows: list[tuple[int, list[str]]], what: str, cell: np.ndarray | None, unit=None) -> Atoms:
    """Atoms from lines of number, name and position. `unit` (3, 3): the vectors in which positions are given."""
    position = table(path, [(k, words[2:5] if len(words) > 4 else [" ".join(words)]) for k, words in rows], what)
    position = position if unit is None else position @ unit
    names = [words[1] for _, words in rows]
    return Atoms(names, [""] * len(names), [()] * len(names), position.reshape(-1, 3), cell=cell)


def read_cssr(path: Path, lines: list[str]) -> list[Callable[[], Atoms]]:
    """Cambridge Structure Search and Retrieval: edges, angles, number of atoms, kind of coordinates, title, atoms."""
    return [partial(_cssr_atoms, path, lines)]


def _cssr_atoms(path: Path, lines: list[str]) -> Atoms:
    if len(lines) < 4:
        raise structure_error(path, "is too short for a .cssr: truncated?")
    edges, angles = (re.findall(r"\d+\.\d*", line)[:3] for line in lines[:2])
    what = "the edges and angles of the cell in the first two lines"
    if len(edges) < 3 or len(angles) < 3:
        raise structure_error(path, f"expected {what}")
    if re.search(r"SPGR\s*=\s*(?!1?\s*P\s*1\s*$)\S", lines[1]):
        raise structure_error(path, f"has the space group {lines[1].split('=')[-1].strip()}; only P1 is read")
    cell = required_cell(path, numbers(path, 1, [*edges, *angles], what))
    head = [word for word in lines[2].split() if parse_whole_number(word) is not None]
    count = atom_count(path, 3, head[0] if head else lines[2].strip(), len(lines) - 4)
    rows = [(k, line.split()) for k, line in enumerate(lines[4 : 4 + count], 5)]
    return _listed(path, rows, "an atom of a .cssr: number, name, x, y, z", cell, None if head[1:2] == ["1"] else cell)
