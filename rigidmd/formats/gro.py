"""GRO, of GROMACS. ASE reads neither more digits, nor several frames, nor velocities of some atoms
only. MDAnalysis reads the first frame alone, in single precision, and refuses atoms without
names."""

import re
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from rigidmd.core.toml import parse_whole_number
from rigidmd.formats import Format, Topology, register
from rigidmd.formats.atoms import Atoms, joined_numbers, numbers, structure_error, unexpected

NM_PER_A = 0.1
#: Numbers with more digits than a column are written without the leading ones.
MOST_DIGITS = 100_000
#: Indices in a cell of the numbers after its diagonal: a_y a_z, b_x b_z, c_x c_y.
OFF_DIAGONAL = [0, 0, 1, 1, 2, 2], [1, 2, 0, 2, 0, 1]


def read_gro(path: Path, lines: list[str]) -> list[Callable[[], Atoms]]:
    """The frames of a .gro: title, number of atoms, atoms, box. Once or more."""
    while lines and not lines[-1].strip():
        lines.pop()
    frames = []
    first = 0
    while first < len(lines):
        promised = lines[first + 1].strip() if first + 1 < len(lines) else ""
        if (count := parse_whole_number(promised)) is None:
            if lines[first].strip():
                raise unexpected(path, first + 2, "the number of atoms", promised)
            first += 1  # an empty line, not an empty title
            continue
        box = first + 2 + count
        if box >= len(lines):
            reason = f"{max(0, len(lines) - first - 3)} are there: truncated?"
            raise structure_error(
                path, f"line {first + 2} promises {count} atoms and a box, {reason}"
            )
        cell = cell_of_line(path, box + 1, lines[box], " (is the number of atoms right?)")
        frames.append(partial(_gro_frame, path, lines, first, box, cell))
        first = box + 1
    return frames


def cell_of_line(path: Path, line: int, text: str, hint: str = "") -> np.ndarray:
    """The cell (3, 3), Å, of three or nine numbers in nm. Raises StructureError."""
    what = f"the box, 3 or 9 numbers{hint}"
    edges = numbers(path, line, joined_numbers(text), what)
    if len(edges) not in (3, 9):
        raise unexpected(path, line, what, text.strip())
    xx, yy, zz, xy, xz, yx, yz, zx, zy = [*edges, *[0.0] * (9 - len(edges))]
    return 10 * np.array([[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]])


def _gro_frame(path: Path, lines: list[str], first: int, box: int, cell: np.ndarray) -> Atoms:
    """The frame in lines `first` to `box`. Column width is the distance between decimal points, as
    in GROMACS."""
    names, residue = [], []
    position = np.zeros((box - first - 2, 3))
    velocity = np.full((box - first - 2, 3), np.nan)
    points = (
        [m.start() for m in re.finditer(r"\.", lines[first + 2][20:])] if box > first + 2 else []
    )
    width = points[1] - points[0] if len(points) > 1 else 8
    cuts = list(pairwise(range(20, 21 + 6 * width, width)))
    for k in range(first + 2, box):
        line = lines[k]
        fields = [line[a:b] for a, b in cuts]
        values = [field.strip() for field in fields]
        what = (
            f"an atom of a .gro with coordinates in columns of {width} (is the number of atoms"
            " right?)"
        )
        # of wider numbers, the next column starts with the end
        is_moved = points and any("." in x and x.find(".") != points[0] for x in fields[:3])
        if is_moved and any(
            line[b - 1 : b].strip() and line[b : b + 1].strip() for _, b in cuts[:3]
        ):
            raise unexpected(path, k + 1, what, line[20:])
        position[k - first - 2] = numbers(path, k + 1, values[:3], what)
        if words := [v for v in values[3:] if v]:
            if len(words) != 3:
                raise unexpected(path, k + 1, "three velocities or none", " ".join(words))
            components = numbers(path, k + 1, words, "three velocities")
            if not np.isfinite(components).all():
                owner = f"line {k + 1}: atom {k - first - 1}"
                raise structure_error(path, f"{owner} has a velocity that is not a finite number")
            velocity[k - first - 2] = components
        names.append(line[10:15].strip())
        residue.append((parse_whole_number(line[:5].strip()), line[5:10].strip()))
    moving = None if np.isnan(velocity).all() else 10 * velocity
    rounding = 10 * 10.0 ** -(width - points[0] - 1) if points else 0.0
    return Atoms(names, [""] * len(names), residue, 10 * position, moving, cell, rounding=rounding)


def gro_text(system: Topology) -> str:
    """One frame without velocities. The numbers of residues and atoms have five digits, of which
    the leading ones are left out."""
    lines = ["Written by rigidmd", f"{len(system.names):5d}"]
    positions = (NM_PER_A * system.positions).tolist()
    rows = zip(system.residues, system.residue_names, system.names, positions, strict=True)
    for k, (residue, residue_name, name, (x, y, z)) in enumerate(rows, 1):
        lines.append(
            f"{residue % MOST_DIGITS:5d}{residue_name:<5.5s}{name:>5.5s}{k % MOST_DIGITS:5d}"
            f"{x:8.3f}{y:8.3f}{z:8.3f}"
        )
    cell = NM_PER_A * (np.zeros((3, 3)) if system.cell is None else system.cell)
    edges = [*np.diag(cell), *cell[OFF_DIAGONAL]]
    lines.append("".join(f"{edge:10.5f}" for edge in (edges if any(edges[3:]) else edges[:3])))
    return "".join(f"{line}\n" for line in lines)


register(
    Format(
        (".gro",),
        read=read_gro,
        topology=gro_text,
        limits=(-9999.9, 99999.9),  # columns of eight
        content=re.compile(r"\A(?:[ \t]*\n)*.*\n[ \t]*\d+[ \t]*\n.{20}( *-?\d+\.\d+){3}"),
    )
)
