"""Charges: Coulomb's law within a cut-off, with the reaction field of a continuum beyond it."""

from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements, is_a, kernel
from rigidmd.compile.simd import inverse_root, load, root_and_cube, zeros
from rigidmd.forces.neighbors import pair_loop as pairs
from rigidmd.forces.potentials.truncation import (
    NO_SWITCH,
    SWITCHES,
    Addend,
    Correction,
    Name,
    Polynomial,
    Shape,
    addend,
    addend_of,
    correction,
    correction_of,
    ended,
    ending,
    needs_root,
    shape_of,
)
from rigidmd.units import COULOMB_CHARGE


class ReactionField(NamedTuple):
    """q_i q_j (1/r + field r²), with an ending at the cut-off.

    field = (eps - 1)/((2 eps + 1) cutoff³) is the response of a continuum of permittivity eps beyond the cut-off to the
    charges inside (Tironi et al. 1995, J. Chem. Phys. 102, 5451). Without a cut-off the field is 0: plain Coulomb.
    """

    cutoff: float  # Å
    shape: Shape
    end: Polynomial  # see endings.ending
    field: float  # 1/Å³
    charge: np.ndarray  # (s,) in units where q²/r is an energy in u Å²/ps²
    switched: Addend | Correction | tuple[()] = NO_SWITCH

    def room(self, slots: int, dtype: type) -> "ReactionField":
        """The law with room for the charges in slots, in the precision of lanes."""
        powers = {1: 1.0, 0: self.end[0], -2: self.field}
        switched = correction_of(self.shape, powers, dtype) or addend_of(self.shape, powers, dtype)
        return self._replace(charge=zeros(slots, dtype), switched=switched)


def reaction_field(
    charge_e: np.ndarray, cutoff: float, permittivity: float = inf, name: Name = "plain", start: float = 0.0
) -> ReactionField:
    """The law for sites with charges (s,) in e; the permittivity of the continuum is `inf` for a conductor."""
    shape = shape_of(name, cutoff, start)
    strength = 0.5 if permittivity == inf else (permittivity - 1) / (2 * permittivity + 1)
    field = strength / cutoff**3

    def at(r: float) -> tuple[float, float, float]:
        return 1 / r + field * r**2, 1 / r**2 - 2 * field * r, -2 / r**3 - 2 * field

    # A switching function multiplies the energy near the cut-off, which must be small there, so the energy is first
    # shifted to zero at the cut-off. Unshifted, a pair of unit charges would lose 230 kJ/mol between 8 and 9 Å.
    end = ending("shift" if name in SWITCHES else name, shape, at)
    return ReactionField(cutoff, shape, end, field, charge_e * COULOMB_CHARGE)


def powers(shape, switched, r2):
    """1/r, and two factors of 1/r³; where the force needs no 1/r they are found without it."""
    raise TypeError("compiled code only")


@implements(powers, inline=True)
def _powers_of(shape, switched, r2):
    if not needs_root(shape, switched):
        return lambda shape, switched, r2: root_and_cube(r2)

    def of_inverse(shape, switched, r2):
        inverse = inverse_root(r2)
        return inverse, inverse, inverse * inverse

    return of_inverse


@kernel(inline=True, outer=True)
def radial(law, r2):
    """(energy, force/r) of two unit charges at squared distance r2, a number or a vector."""
    inverse, one, two = powers(law.shape, law.switched, r2)
    u = inverse + law.field * r2 + law.end[0]
    w = (1 + addend(law.shape, law.switched, r2 * inverse)) * one * two - 2 * law.field
    w = w + correction(law.shape, law.switched, r2)
    return ended(law.shape, law.end, law.switched, r2, inverse, u, w)


@implements(pairs.pair, ReactionField, inline=True)
def _pair(law, i, j, r2):
    qq = law.charge[i] * load(law.charge, j)
    u, w = radial(law, r2)
    return qq * u, qq * w


@implements(pairs.arrange)
def _arrange(law, arranged, order):
    if not is_a(law, ReactionField):
        return None
    return lambda law, arranged, order: pairs.into_slots(law.charge, arranged.charge, order)


def self_energy(law: ReactionField, position: np.ndarray) -> float:
    """Energy (u Å²/ps²) of one molecule's charges in their own reaction field.

    position (s, 3) of the molecule's charged sites, in the order of the first s of law.charge. It is constant for a
    rigid body, so it exerts no force; for a neutral molecule of dipole mu well inside the cut-off it is -field mu².
    """
    charge = law.charge[: len(position)]
    energy = 0.5 * charge @ charge * law.end[0]
    for i in range(len(position)):
        for j in range(i):
            r2 = float(np.sum((position[i] - position[j]) ** 2))
            u = radial(law, r2)[0] if r2 < law.cutoff**2 else 0.0
            energy += charge[i] * charge[j] * (u - 1 / sqrt(r2))
    return float(energy)
