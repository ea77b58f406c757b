"""Harmonic restraints of the centres of mass of some molecules to reference positions in the lab."""

from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements
from rigidmd.core.state import OK
from rigidmd.forces.terms import add_forces


class Restraints(NamedTuple):
    """U = sum over restrained molecules and axes of stiffness/2 (R - reference)². R is never wrapped."""

    molecule: np.ndarray  # (r,) int64, each once
    reference: np.ndarray  # (r, 3) lab frame, Å
    stiffness: np.ndarray  # (3,) along x, y, z, u/ps²

    tied_to_places = True

    @property
    def changes_momentum(self) -> np.ndarray:
        """Components (3,) of the total momentum that they change."""
        return self.stiffness != 0


@implements(add_forces, Restraints)
def _add_restraints(term, state, load, tally):
    for r in range(len(term.molecule)):
        m = term.molecule[r]
        for k in range(3):
            away = state.position[m, k] - term.reference[r, k]
            load.force[m, k] -= term.stiffness[k] * away
            if tally is not None:
                tally[0] += 0.5 * term.stiffness[k] * away * away
    return OK
