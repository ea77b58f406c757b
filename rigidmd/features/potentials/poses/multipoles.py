"""Point dipoles and point quadrupoles on bodies, along an axis.

k = 1/(4 pi epsilon_0); u, v: axes; c = u r/|r|, d = v r/|r|, e = u v. Within the cutoff R of a
reaction field of a conductor a dipole has the further energy -k m n e/R³, and a linear quadrupole
none.
Gray & Gubbins 1984, Theory of Molecular Fluids, eq. 2.180; Barker & Watts 1973, Mol. Phys. 26, 789.
"""

from collections.abc import Callable
from math import inf

import numpy as np

from rigidmd.units import COULOMB, DEBYE, KJ_PER_MOL

#: k in kJ/mol Å³/D².
PER_DEBYE_SQUARED = COULOMB / KJ_PER_MOL * DEBYE**2
DIPOLE, QUADRUPOLE = ("dipole_D",), ("quadrupole_D_A",)


def dipole(reaction_field_A: float = inf) -> Callable:
    """The energy (kJ/mol) of two dipoles (debye) along an axis.

    reaction_field_A : radius of the cavity of a conductor's reaction field, Å; inf for none
    """

    def energy(r, u, v, p, q):
        distance = np.sqrt(r @ r)
        product = PER_DEBYE_SQUARED * p.dipole_D * q.dipole_D
        direct = (u @ v) / distance**3 - 3 * (u @ r) * (v @ r) / distance**5
        return product * (direct - (u @ v) / reaction_field_A**3)

    return energy


def quadrupole() -> Callable:
    """The energy (kJ/mol) of two linear quadrupoles (debye Å) along an axis."""

    def energy(r, u, v, p, q):
        square = r @ r
        distance = np.sqrt(square)
        c, d, e = (u @ r) / distance, (v @ r) / distance, u @ v
        angles = 1 - 5 * c**2 - 5 * d**2 - 15 * (c * d) ** 2 + 2 * (e - 5 * c * d) ** 2
        product = PER_DEBYE_SQUARED * p.quadrupole_D_A * q.quadrupole_D_A
        return 0.75 * product * angles / (square * square * distance)

    return energy
