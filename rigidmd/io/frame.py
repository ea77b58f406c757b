"""A frame of a run in memory."""

from typing import NamedTuple

import numpy as np


class Frame(NamedTuple):
    """A time (ps); without a trajectory file also positions (s, 3) and velocities (s, 3) of sites, cell (3, 3) and
    rotations (n, 3, 3), Å and Å/ps."""

    time: float
    positions: np.ndarray | None = None
    cell: np.ndarray | None = None
    velocities: np.ndarray | None = None
    rotation: np.ndarray | None = None

    @property
    def sites(self) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None]:
        """Positions, velocities and cell."""
        return self.positions, self.velocities, self.cell
