"""The cell of a system: a periodic box with right angles, a triclinic one, or none."""

from math import inf, prod
from typing import NamedTuple

import numpy as np

from rigidmd.compile import kernel


class Orthorhombic(NamedTuple):
    """Periodic box with right angles. Edges in Å."""

    x: float
    y: float
    z: float

    @property
    def edges(self) -> tuple[float, float, float]:
        """Edges of the orthorhombic brick that repeats along the cell vectors, Å."""
        return tuple(self[:3])

    @property
    def volume(self) -> float:
        """Å³"""
        return prod(self.edges)


class Triclinic(NamedTuple):
    """Periodic box of any shape: a = (x, 0, 0), b = (xy, y, 0), c = (xz, yz, z), Å. The names are
    those of LAMMPS. A brick with edges x, y, z repeats along a, b and c without gaps too. Sites are
    shifted into that brick, where lists for an orthorhombic box are used."""

    x: float
    y: float
    z: float
    xy: float
    xz: float
    yz: float

    edges = Orthorhombic.edges
    volume = Orthorhombic.volume


class Unbounded(NamedTuple):
    """No box: droplets and clusters in vacuum, with infinite edges."""

    x: float = inf
    y: float = inf
    z: float = inf

    edges = Orthorhombic.edges
    volume = Orthorhombic.volume


Space = Orthorhombic | Triclinic | Unbounded


def space_of(cell: np.ndarray | None) -> Space:
    """The space with this cell matrix (3, 3), rows a, b, c with a along x and b in the xy plane, Å.
    None for no box."""
    if cell is None or cell[0, 0] == inf:
        return Unbounded()
    (x, _, _), (xy, y, _), (xz, yz, z) = (map(float, row) for row in cell)
    return Triclinic(x, y, z, xy, xz, yz) if xy or xz or yz else Orthorhombic(x, y, z)


def cell_of(space: Space) -> np.ndarray:
    """Cell matrix (3, 3), rows the edges a, b, c, Å."""
    cell = np.diag(np.array(space.edges))
    if isinstance(space, Triclinic):
        cell[1, 0], cell[2, 0], cell[2, 1] = space[3:]
    return cell


def wrap(space: Space, position: np.ndarray) -> np.ndarray:
    """Positions (n, 3) shifted by whole edges into the cell. Unchanged without a box."""
    if isinstance(space, Unbounded):
        return position
    return position - np.floor(fractions(space, position)) @ cell_of(space)


def fractions(space: Space, position: np.ndarray) -> np.ndarray:
    """Positions (n, 3) of a periodic box as fractions (n, 3) of its edges a, b, c."""
    cell = cell_of(space)
    x, y, z = position.T
    c = z / cell[2, 2]
    b = (y - c * cell[2, 1]) / cell[1, 1]
    a = (x - b * cell[1, 0] - c * cell[2, 0]) / cell[0, 0]
    return np.stack([a, b, c], axis=1)


def longest_gaps(space: Space, position: np.ndarray) -> np.ndarray:
    """The longest part (3,) of each periodic box edge that has none of the positions (n, 3), Å."""
    fraction = np.sort(fractions(space, position) % 1.0, axis=0)
    return np.diff(fraction, axis=0, append=fraction[:1] + 1.0).max(axis=0) * space.edges


@kernel(inline=True)
def volume_of(cell):
    """Volume of a cell (3, 3) in standard orientation, Å³."""
    return cell[0, 0] * cell[1, 1] * cell[2, 2]


@kernel
def follow_cell(cell, known):
    """Copy a cell (3, 3) into `known`. Whether that has changed."""
    changed = False
    for k in range(3):
        for n in range(3):
            changed |= known[k, n] != cell[k, n]
            known[k, n] = cell[k, n]
    return changed


@kernel(inline=True)
def nearest_image(cell, x, y, z):
    """The nearest image of a vector, Å, in a cell (3, 3) with a along x and b in the xy plane; for
    vectors within half of the shortest edge."""
    if cell[0, 0] < inf:
        x, y, z = image_in_box(cell, x, y, z)
    return x, y, z


@kernel(inline=True)
def image_in_box(cell, x, y, z):
    """`nearest_image` where there is a box. A loop over many vectors asks for the box once, before:
    insertions take 1.8 times as long if it does not."""
    along = np.rint(z / cell[2, 2])
    x, y, z = x - along * cell[2, 0], y - along * cell[2, 1], z - along * cell[2, 2]
    along = np.rint(y / cell[1, 1])
    x, y = x - along * cell[1, 0], y - along * cell[1, 1]
    return x - np.rint(x / cell[0, 0]) * cell[0, 0], y, z
