"""A frame of a run in memory."""

from typing import NamedTuple

import numpy as np


class Frame(NamedTuple):
    """A time (ps); without a trajectory file also positions (s, 3) and cell (3, 3), Å."""

    time: float
    positions: np.ndarray | None = None
    cell: np.ndarray | None = None
