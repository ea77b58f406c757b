"""Lennard-Jones: 4 epsilon ((sigma/r)¹² - (sigma/r)⁶), its endings at the cut-off, mixing rules, tail correction."""

from math import pi, sqrt
from typing import Literal, NamedTuple

import numpy as np
from scipy.integrate import quad

from rigidmd.forces import pairs
from rigidmd.forces.truncation import Name, added, ending, shape_of, switching
from rigidmd.jit import PAIR_FLAGS, implements, is_a

Mixing = Literal["lorentz-berthelot", "geometric"]


class LennardJones(NamedTuple):
    """c12/r¹² - c6/r⁶ between kinds of sites, each power with its own ending."""

    cutoff: float  # Å
    start: float  # Å, see truncation.Shape
    switched: int
    end12: np.ndarray  # (4,) see truncation.ending
    end6: np.ndarray  # (4,)
    kind: np.ndarray  # (s,) kind of each site, index into c6 and c12
    c12: np.ndarray  # (kinds, kinds) u Å¹⁴/ps²
    c6: np.ndarray  # (kinds, kinds) u Å⁸/ps²


def lennard_jones(
    kind: np.ndarray,
    sigma: np.ndarray,
    epsilon: np.ndarray,
    cutoff: float,
    name: Name = "plain",
    start: float = 0.0,
    mixing: Mixing = "lorentz-berthelot",
    special: dict[tuple[int, int], tuple[float, float]] | None = None,
) -> LennardJones:
    """The law for sites of kinds (s,) with sigma (kinds,) in Å and epsilon (kinds,) in u Å²/ps².

    special : (kind, kind) -> (sigma, epsilon) in place of the mixing rule, for both orders of the kinds
    """
    shape = shape_of(name, cutoff, start)
    sigma_ij = (sigma[:, None] + sigma) / 2 if mixing == "lorentz-berthelot" else np.sqrt(sigma[:, None] * sigma)
    epsilon_ij = np.sqrt(epsilon[:, None] * epsilon)
    for (i, j), (own_sigma, own_epsilon) in (special or {}).items():
        sigma_ij[[i, j], [j, i]] = own_sigma
        epsilon_ij[[i, j], [j, i]] = own_epsilon
    return LennardJones(
        *shape,
        ending(name, shape, _inverse_power(12)),
        ending(name, shape, _inverse_power(6)),
        kind,
        4 * epsilon_ij * sigma_ij**12,
        4 * epsilon_ij * sigma_ij**6,
    )


def _inverse_power(p: int):
    """r⁻ᵖ, its force and the derivative of its force."""
    return lambda r: (r**-p, p * r ** -(p + 1), -p * (p + 1) * r ** -(p + 2))


@implements(pairs.pair, PAIR_FLAGS, inline=True)
def _pair(law, i, j, r2):
    if not is_a(law, LennardJones):
        return None

    def pair(law, i, j, r2):
        c12 = law.c12[law.kind[i], law.kind[j]]
        c6 = law.c6[law.kind[i], law.kind[j]]
        inverse2 = 1 / r2
        six = inverse2 * inverse2 * inverse2
        u = c12 * (six * six + law.end12[0]) - c6 * (six + law.end6[0])
        w = (12 * c12 * six - 6 * c6) * six * inverse2
        if r2 > law.start * law.start:
            r = sqrt(r2)
            if law.switched:
                s, slope = switching(law.switched, law.cutoff, law.start, r)
                w = s * w - slope * u / r
                u = s * u
            else:
                u12, f12 = added(law.end12, r - law.start)
                u6, f6 = added(law.end6, r - law.start)
                u += c12 * u12 - c6 * u6
                w += (c12 * f12 - c6 * f6) / r
        return u, w

    return pair


def tail(law: LennardJones, volume: float) -> tuple[float, float]:
    """Energy (u Å²/ps²) and pressure (u/(Å ps²)) that the cut-off takes away, for g(r) = 1 beyond where it acts.

    U = (2 pi / V) sum_ij N_i N_j J_ij with J = integral of r² (full - truncated); for endings that shift the whole
    potential the constant inside counts too, as in GROMACS' dispersion correction. Allen & Tildesley (2017), 2.8.
    All N² pairs are counted, those of a molecule with itself among them: a relative error of 1/(number of molecules).
    """
    count = np.bincount(law.kind, minlength=len(law.c6))
    energy = pressure = 0.0
    for sign, c, p, end in ((1, law.c12, 12, law.end12), (-1, law.c6, 6, law.end6)):
        lost = _lost(law, end, p)
        # The pressure is that of the force alone: a jump of the energy at the cut-off (plain) has none.
        jump = law.cutoff ** (3 - p) / 3 if end[0] == 0 and not law.switched else 0.0
        strength = sign * count @ c @ count
        energy += 2 * pi / volume * strength * lost
        pressure += 2 * pi / volume**2 * strength * (lost + jump)
    return energy, pressure


def _lost(law: LennardJones, end: np.ndarray, p: int) -> float:
    """Integral of r² (r⁻ᵖ - truncated r⁻ᵖ) over all r."""
    beyond = law.cutoff ** (3 - p) / (p - 3)
    inside = -end[0] * law.cutoff**3 / 3

    def ended(r: float) -> float:
        if law.switched:
            return (1 - switching(law.switched, law.cutoff, law.start, r)[0]) * r ** (2 - p)
        return -(r**2) * added(end, r - law.start)[0]

    if law.start < law.cutoff:
        inside += quad(ended, law.start, law.cutoff)[0]
    return beyond + inside
