"""The sites of a system, as output and analysis read them."""

from typing import NamedTuple

import numpy as np


class Sites(NamedTuple):
    """All sites of a system, molecule by molecule, for output and analysis."""

    molecule: np.ndarray  # (s,)
    offset_body: np.ndarray  # (s, 3)
    name: np.ndarray  # (s,) text
    element: np.ndarray  # (s,) text
    mass: np.ndarray  # (s,)

    def __repr__(self) -> str:
        return f"<Sites: {len(self.name)} of {len(np.unique(self.molecule))} molecules>"
