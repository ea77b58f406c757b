"""Periodic cells as files give them: any lattice vectors, oriented in any way. Rows a, b, c, lab frame, Å."""

import numpy as np

#: Cosine up to which two edges count as at right angles: files print angles to 0.01 degrees, vectors to 1e-5 or better.
RIGHT = np.radians(1e-3)
#: A cell whose vectors lie closer to the standard orientation than this fraction of its longest edge is left as it is.
ORIENTED = 1e-6


def standard_rotation(cell: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The cell (3, 3) with a along x, b in the xy plane and c above it, and the rotation R (3, 3) that turns it so.

    The new rows are R times the old ones; of a left-handed cell c is turned round, which leaves the lattice as it is.
    """
    cell = cell * np.array([1, 1, np.sign(np.linalg.det(cell))])[:, None]
    longest = np.abs(cell).max()
    if np.abs(np.triu(cell, 1)).max() <= ORIENTED * longest and (np.diag(cell) > 0).all():
        return np.tril(cell), np.eye(3)
    q, r = np.linalg.qr(cell.T)
    q = q * np.sign(np.diag(r))
    return np.tril(cell @ q), q.T


def right_angled(cell: np.ndarray) -> bool:
    """Whether the edges of a cell (3, 3) are at right angles to one another, as far as files tell."""
    unit = cell / np.linalg.norm(cell, axis=1)[:, None]
    return bool(np.abs((unit @ unit.T)[np.triu_indices(3, 1)]).max() <= RIGHT)


def angles_deg(cell: np.ndarray) -> np.ndarray:
    """alpha, beta, gamma (3,) of a cell (3, 3), degrees."""
    unit = cell / np.linalg.norm(cell, axis=1)[:, None]
    return np.degrees(np.arccos([unit[1] @ unit[2], unit[2] @ unit[0], unit[0] @ unit[1]]))
