"""Reader of LAMMPS' binary dumps (`dump custom` to a file with extension .bin), in the format since 2020."""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigidmd.errors import EngineError
from rigidmd.io.formats.lammps import box_in_bounds

MAGIC = b"DUMPCUSTOM"


class Dump(NamedTuple):
    step: int
    low: np.ndarray  # (3,) of the box, Å
    cell: np.ndarray  # (3, 3) rows a, b, c
    rows: np.ndarray  # (s, columns) sorted by the first column


def read_dump(path: Path) -> Dump:
    """The first frame of a dump whose first column is the number of the atom. Raises EngineError."""
    data = path.read_bytes()
    at = 0

    def take(form: str) -> tuple:
        nonlocal at
        found = struct.unpack_from(f"<{form}", data, at)
        at += struct.calcsize(f"<{form}")
        return found

    try:
        (mark,) = take("q")  # below zero: the length of the name that follows
        if take(f"{max(-mark, 0)}s") != (MAGIC,):
            raise ValueError("not a file of `dump custom`")
        take("ii")  # byte order, revision
        step, _, slanted = take("qqi")
        take("6i")  # kinds of boundaries
        xlo, xhi, ylo, yhi, zlo, zhi = take("6d")
        xy, xz, yz = take("3d") if slanted else (0.0, 0.0, 0.0)
        (columns,) = take("i")
        (units,) = take("i")
        take(f"{units}s")
        if take("c") != (b"\0",):
            take("d")  # time
        (words,) = take("i")
        take(f"{words}s")
        (pieces,) = take("i")
        rows = []
        for _ in range(pieces):
            (count,) = take("i")
            rows.append(np.frombuffer(data, np.float64, count, at).reshape(-1, columns))
            at += 8 * count
    except (struct.error, ValueError) as error:
        raise EngineError(f"LAMMPS wrote a dump that cannot be read: {error}") from None
    low, cell = box_in_bounds(np.array([xlo, ylo, zlo]), np.array([xhi, yhi, zhi]), xy, xz, yz)
    table = np.concatenate(rows)
    return Dump(step, low, cell, table[table[:, 0].argsort()])
