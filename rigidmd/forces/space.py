"""The space molecules live in: an orthorhombic periodic box, or none. Chosen by type, so no box costs nothing."""

from math import inf
from typing import NamedTuple

import numpy as np

from rigidmd.jit import PAIR_FLAGS, implements, is_a


class Orthorhombic(NamedTuple):
    """Periodic box with right angles. Edges in Å."""

    x: float
    y: float
    z: float

    @property
    def volume(self) -> float:
        """Å³"""
        return self.x * self.y * self.z


class Unbounded(NamedTuple):
    """No box: droplets and clusters in vacuum. The edges are infinite."""

    x: float = inf
    y: float = inf
    z: float = inf

    @property
    def volume(self) -> float:
        """Infinite."""
        return inf


Space = Orthorhombic | Unbounded


def nearest_image(space, dx, dy, dz):
    """The shortest periodic image of a displacement (Å); itself where there is no box."""
    raise TypeError("compiled code only")


@implements(nearest_image, PAIR_FLAGS, inline=True)
def _nearest_image(space, dx, dy, dz):
    if is_a(space, Unbounded):
        return lambda space, dx, dy, dz: (dx, dy, dz)

    def nearest(space, dx, dy, dz):
        # 1/x is the same all along a loop and leaves it; dx / x would be a division for every pair.
        return (
            dx - space.x * np.rint(dx * (1 / space.x)),
            dy - space.y * np.rint(dy * (1 / space.y)),
            dz - space.z * np.rint(dz * (1 / space.z)),
        )

    return nearest


def wrap_index(space, index, count):
    """Cell index along one axis brought into 0 ... count - 1, or -1 for a cell outside an unbounded space."""
    raise TypeError("compiled code only")


@implements(wrap_index, inline=True)
def _wrap_index(space, index, count):
    if is_a(space, Unbounded):
        return lambda space, index, count: index if 0 <= index < count else -1
    return lambda space, index, count: index % count


def cell_of(space: Space) -> np.ndarray:
    """Cell matrix (3, 3), rows the edges a, b, c, Å."""
    return np.diag(np.array(space))


def fill_cell(space, cell):
    """Write the cell matrix (3, 3), rows the edges a, b, c, into an array; whether it has changed."""
    raise TypeError("compiled code only")


@implements(fill_cell)
def _fill_cell(space, cell):
    if not is_a(space, Orthorhombic):
        return None

    def fill(space, cell):
        changed = cell[0, 0] != space.x or cell[1, 1] != space.y or cell[2, 2] != space.z
        cell[:] = 0.0
        cell[0, 0] = space.x
        cell[1, 1] = space.y
        cell[2, 2] = space.z
        return changed

    return fill
