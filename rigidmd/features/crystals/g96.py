"""G96, of GROMACS and GROMOS. ASE takes NA for N, refuses massless sites, and reads neither
velocities, residues nor frames. MDAnalysis does not know it."""

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from rigidmd.core.toml import parse_whole_number
from rigidmd.formats import Format, register
from rigidmd.formats.atoms import Atoms, joined_numbers, numbers, structure_error, unexpected
from rigidmd.formats.gro import cell_of_line

#: Columns before the coordinates: number and name of the residue, name and number of the atom.
HEAD = 24
#: Names of blocks; those that end in RED have coordinates only.
POSITIONS, VELOCITIES = ("POSITION", "POSITIONRED"), ("VELOCITY", "VELOCITYRED")
USED = {*POSITIONS, *VELOCITIES, "BOX"}
WITHOUT_ATOMS = {"TITLE", "TIMESTEP"}

#: A line and its number.
Lines = list[tuple[int, str]]


def read_g96(path: Path, lines: list[str]) -> list[Callable[[], Atoms]]:
    """The frames of a .g96: blocks from a name to END, of which POSITION starts a frame."""
    frames: list[dict[str, Lines]] = []
    unused = []
    block = ""
    content = []
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if text.startswith("#") or (not text and not block):
            continue
        if not block:
            block = text
            content = []
        elif text == "END":
            if block in POSITIONS:
                frames.append({})
            if frames and block in USED:
                frames[-1][block] = content
            elif block not in WITHOUT_ATOMS and block not in unused:
                unused.append(block)
            block = ""
        else:
            content.append((number, line))
    if block:
        raise structure_error(path, f"its block {block} has no END: truncated?")
    notes = [f"its blocks {', '.join(unused)} are not used"] if unused else []
    return [partial(_frame, path, frame, frames[0], notes) for frame in frames]


def _frame(path: Path, frame: dict[str, Lines], first: dict[str, Lines], notes: list[str]) -> Atoms:
    """A frame. Names are in its block POSITION, or else in the first frame."""
    named = frame.get("POSITION", first.get("POSITION"))
    if named is None:
        raise structure_error(path, "has no block POSITION, and so no names of atoms")
    position, velocity = (_vectors(path, frame, blocks) for blocks in (POSITIONS, VELOCITIES))
    for what, vectors in (("positions", position), ("velocities", velocity)):
        if len(vectors) not in (0, len(named)):
            raise structure_error(path, f"has {len(vectors)} {what} of {len(named)} atoms")
    names, residue = [], []
    for number, line in named:
        words = line[:HEAD].split()
        if len(words) < 3:
            raise unexpected(path, number, "residue number, residue name, atom name", line.strip())
        names.append(words[2])
        residue.append((parse_whole_number(words[0]), words[1]))
    box = frame.get("BOX")
    return Atoms(
        names,
        [""] * len(names),
        residue,
        position,
        velocity if len(velocity) else None,
        cell_of_line(path, box[0][0], " ".join(line for _, line in box)) if box else None,
        notes=notes,
    )


def _vectors(path: Path, frame: dict[str, Lines], blocks: tuple[str, ...]) -> np.ndarray:
    """Vectors (n, 3) of a block in Å or Å/ps. (0, 3) without one."""
    name = next((block for block in blocks if block in frame), "")
    start = 0 if name.endswith("RED") else HEAD
    rows = []
    for number, line in frame.get(name, ()):
        words = joined_numbers(line[start:])
        if len(words) != 3:
            raise unexpected(
                path, number, f"three numbers of {name} from column {start + 1}", line.strip()
            )
        rows.append(numbers(path, number, words, f"three numbers of {name}"))
    return 10 * np.array(rows).reshape(-1, 3)


register(
    Format(
        (".g96",),
        read=read_g96,
        content=re.compile(r"\ATITLE[ \t]*\n(?:.*\n)*?(?:TIMESTEP|POSITION)"),
    )
)
