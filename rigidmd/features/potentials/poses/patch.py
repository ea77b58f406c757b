"""Spheres with one soft attractive patch.

U = 4 epsilon ((sigma/r)¹² - g(c) g(-d) (sigma/r)⁶), g(x) = exp(-(1 - x)/width), with the cosines c
and d of the angles between the axes and the vector from the first to the second sphere: patches
attract each other if they face each other, and the spheres repel otherwise.
"""

from typing import NamedTuple

import numpy as np

PARAMETERS = ("sigma_A", "epsilon_kJ_mol", "width")


class Patch(NamedTuple):
    """The energy (kJ/mol) of two spheres with patches along an axis."""

    def __call__(self, r, u, v, p, q):
        square = r @ r
        distance = np.sqrt(square)
        sigma, width = (p.sigma_A + q.sigma_A) / 2, (p.width + q.width) / 2
        facing = np.exp(((u @ r - v @ r) / distance - 2) / width)
        six = (sigma * sigma / square) ** 3
        return 4 * np.sqrt(p.epsilon_kJ_mol * q.epsilon_kJ_mol) * (six * six - facing * six)
