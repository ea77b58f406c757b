"""The potential of Gay and Berne between uniaxial ellipsoids, equal or not.

U = 4 epsilon(u, v, r) (s¹² - s⁶), s = gamma sigma_0 / (r - sigma(u, v, r) + gamma sigma_0)

sigma is the distance of contact along r, and sigma_0 is the mean of the widths. The parameters are
those of LAMMPS; with equal ellipsoids, upsilon = 1, mu = 2 these are the exponents nu = 1, mu = 2
of GB(kappa, kappa', mu, nu), with kappa = length/width and kappa' = side/end.
Gay & Berne 1981, J. Chem. Phys. 74, 3316; unlike ellipsoids: Cleaver, Care, Allen & Neal 1996,
Phys. Rev. E 54, 559, for the contact, and Everaers & Ejtehadi 2003, Phys. Rev. E 67, 041710, for
the strength.
"""

from typing import NamedTuple

import numpy as np

#: Parameters of a kind: length and width (Å), depth of the well of two side by side (kJ/mol), and
#: relative depths of two side by side and end to end.
PARAMETERS = ("length_A", "width_A", "epsilon_kJ_mol", "side", "end")


#: The shifted distance, in widths, below which the energy is constant: it would diverge, and nearer
#: ellipsoids would attract each other.
SHORTEST = 0.1


class GayBerne(NamedTuple):
    """The energy (kJ/mol) as a function of r, the axes of both bodies and their parameters."""

    upsilon: float = 1.0  # exponents of the strength
    mu: float = 2.0
    gamma: float = 1.0  # shift of the distance

    def __call__(self, r, u, v, p, q):
        distance = np.sqrt(r @ r)
        along = (u @ r) / distance, (v @ r) / distance, u @ v
        # radii squared, across and along the axis
        wide, long = (p.width_A / 2) ** 2, (p.length_A / 2) ** 2
        other_wide, other_long = (q.width_A / 2) ** 2, (q.length_A / 2) ** 2
        shape, determinant = _inverse(wide, long, other_wide, other_long, along)
        contact = np.sqrt(2.0) / np.sqrt(shape)
        sizes = (wide + long) * p.width_A / 2 * ((other_wide + other_long) * q.width_A / 2)
        strength = (2 * sizes / determinant) ** (self.upsilon / 2)
        power = -1 / self.mu
        side, end = ([x**power for x in both] for both in ((p.side, q.side), (p.end, q.end)))
        depth, _ = _inverse(side[0], end[0], side[1], end[1], along)
        width = (p.width_A + q.width_A) / 2
        shifted = distance - contact + self.gamma * width
        ratio = width / np.maximum(shifted, SHORTEST * width)
        epsilon = np.sqrt(p.epsilon_kJ_mol * q.epsilon_kJ_mol)
        return 4 * epsilon * strength * (2 * depth) ** self.mu * (ratio**12 - ratio**6)


def _inverse(across, along_axis, other_across, other_along, cosines):
    """r G⁻¹ r for a unit vector r, and det G, with G = sum of two matrices with these values across
    and along the axes u and v. cosines : u r, v r, u v"""
    to_u, to_v, between = cosines
    whole = across + other_across
    first = (along_axis - across) / (along_axis + other_across)
    second = (other_along - other_across) / (other_along + across)
    rest = 1 - first * second * between**2
    mixed = 2 * first * second * to_u * to_v * between
    value = (1 - (first * to_u**2 + second * to_v**2 - mixed) / rest) / whole
    return value, whole * (along_axis + other_across) * (other_along + across) * rest
