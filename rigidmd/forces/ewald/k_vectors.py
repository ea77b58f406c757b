"""The k-vectors of an Ewald sum: integer vectors n, in columns along n_z, with k = 2 pi n times reciprocal edges."""

from math import pi
from typing import NamedTuple

import numpy as np

from rigidmd.compile import BLOCKS

SAME_BASIS = np.eye(3, dtype=int)  #: of a cell whose edges are those of its description


class KVectors(NamedTuple):
    """Half of the vectors n = (n_x, n_y, n_z) of a sum, in columns along n_z; the other half are minus these."""

    column: np.ndarray  # (columns, 4) n_x, n_y, first n_z, index of that vector in the sum
    count: np.ndarray  # (columns,) number of n_z
    most: np.ndarray  # (3,) largest |n| along each axis
    bounds: np.ndarray  # (blocks + 1,) block b has columns bounds[b] ... bounds[b + 1] - 1

    @property
    def total(self) -> int:
        """Number of vectors, with their negatives."""
        return 2 * int(self.count.sum())


def k_vectors_up_to(
    most: tuple[int, int, int], largest_square: int | None = None, basis: np.ndarray = SAME_BASIS
) -> KVectors:
    """All n != 0 with |n_x|, |n_y|, |n_z| up to `most`, and with |n|² up to `largest_square` if given.

    basis (3, 3) : integers; the edges of this cell are `basis` times those of another cell of the same lattice, and the
        bounds apply to n in that cell
    """
    square = np.inf if largest_square is None else largest_square

    def inside(n: np.ndarray) -> np.ndarray:
        other = _in_other(n, basis)
        return (np.abs(other) <= most).all(axis=-1) & ((other**2).sum(axis=-1) <= square)

    return _in_columns(np.abs(basis) @ most, inside)


def k_vectors_within(
    reciprocal: np.ndarray, radius: float, limit: tuple[int, int, int] | None = None, basis: np.ndarray = SAME_BASIS
) -> KVectors:
    """All n != 0 with |k| up to `radius` (1/Å), and with |n_x|, |n_y|, |n_z| up to `limit` if given.

    reciprocal (3, 3) : rows 2 pi times the reciprocal edges, 1/Å
    basis : for the limit, see `k_vectors_up_to`
    """
    cell = 2 * pi * np.linalg.inv(reciprocal).T
    most = np.floor(radius * np.linalg.norm(cell, axis=1) / (2 * pi)).astype(int)

    def inside(n: np.ndarray) -> np.ndarray:
        short = ((n @ reciprocal) ** 2).sum(axis=-1) <= radius**2
        return short if limit is None else short & (np.abs(_in_other(n, basis)) <= limit).all(axis=-1)

    return _in_columns(most if limit is None else np.minimum(most, np.abs(basis) @ limit), inside)


def _in_other(n: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """The n (..., 3) of the same k-vectors in the other cell, see `k_vectors_up_to`."""
    return n @ np.rint(np.linalg.inv(basis)).astype(int).T


def _in_columns(most, inside) -> KVectors:
    mx, my, mz = (int(m) for m in most)
    z = np.arange(-mz, mz + 1)
    columns, counts = [], []
    for x in range(mx + 1):
        y = np.arange(-my if x else 0, my + 1)
        n = np.stack(np.broadcast_arrays(x, y[:, None], z), axis=-1)
        found = inside(n) & ((x > 0) | (y[:, None] > 0) | (z > 0))
        here = np.flatnonzero(found.any(axis=1))
        columns.append(np.stack([np.full(len(here), x), y[here], z[found[here].argmax(axis=1)]], axis=1))
        counts.append(np.count_nonzero(found[here], axis=1))
    count = np.concatenate(counts).astype(np.int64)
    ends = np.cumsum(count)
    total = int(count.sum())
    blocks = max(1, min(BLOCKS, len(count)))
    block_ends = np.searchsorted(ends, np.linspace(0, total, blocks + 1)[1:-1])
    return KVectors(
        np.column_stack([np.concatenate(columns), ends - count]).astype(np.int64),
        count,
        np.array([mx, my, mz]),
        np.array([0, *block_ends, len(count)], np.int64),
    )
