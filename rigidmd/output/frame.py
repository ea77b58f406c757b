"""A frame of a run, as it is kept where no file holds it."""

from typing import NamedTuple

import numpy as np


class Frame(NamedTuple):
    """A time (ps), and where none is on the disk, positions (s, 3) and cell (3, 3), Å."""

    time: float
    positions: np.ndarray | None = None
    cell: np.ndarray | None = None
