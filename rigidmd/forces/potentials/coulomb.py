"""Coulomb potential with a reaction field: q_i q_j (1/r + field r²) within a cutoff, a dielectric
beyond it."""

from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.compile import chosen_by_type, implements, kernel
from rigidmd.compile.simd import inverse_root_and_cube, inverse_square_root, load, zeros
from rigidmd.forces.neighbors import pair_loop as pairs
from rigidmd.forces.neighbors.space import Space
from rigidmd.forces.parts import Interactions, SystemParts
from rigidmd.forces.potentials.truncation import (
    NO_SWITCH,
    SWITCHES,
    SwitchCorrection,
    SwitchTerm,
    Truncation,
    TruncationTerms,
    correction,
    needs_root,
    switch_correction_of,
    switch_term,
    switch_term_of,
    truncated,
    truncation_of,
    truncation_terms,
)
from rigidmd.scene.forces import Forces
from rigidmd.scene.truncation import TruncationName
from rigidmd.units import COULOMB_CHARGE


class ReactionField(NamedTuple):
    """q_i q_j (1/r + field r²), truncated at the cutoff; field is k of the theory chapter
    `interactions` (Tironi et al. 1995, J. Chem. Phys. 102, 5451). Without a cutoff the field is 0:
    plain Coulomb."""

    cutoff: float  # Å
    truncation: Truncation
    terms: TruncationTerms  # see truncation.truncation_terms
    field: float  # 1/Å³
    charge: np.ndarray  # (s,) in units where q²/r is an energy in u Å²/ps²
    switched: SwitchTerm | SwitchCorrection | tuple[()] = NO_SWITCH

    acts_on_charges = True

    def for_slots(self, slots: int, dtype: type) -> "ReactionField":
        """The potential with an array for the charges in slots, in the precision of the pair
        loop."""
        powers = {1: 1.0, 0: self.terms[0], -2: self.field}
        switched = switch_correction_of(self.truncation, powers, dtype) or switch_term_of(
            self.truncation, powers, dtype
        )
        return self._replace(charge=zeros(slots, dtype), switched=switched)


def reaction_field(
    charge_e: np.ndarray,
    cutoff: float,
    permittivity: float = inf,
    name: TruncationName = "plain",
    start: float = 0.0,
) -> ReactionField:
    """The potential for sites with charges (s,) in e. A permittivity of `inf` means a conductor."""
    truncation = truncation_of(name, cutoff, start)
    strength = 0.5 if permittivity == inf else (permittivity - 1) / (2 * permittivity + 1)
    field = strength / cutoff**3

    def at(r: float) -> tuple[float, float, float]:
        return 1 / r + field * r**2, 1 / r**2 - 2 * field * r, -2 / r**3 - 2 * field

    # A switching function multiplies the energy near the cutoff, which must be small there, so the
    # energy is first shifted to zero at the cutoff. Unshifted, a pair of unit charges would lose
    # 230 kJ/mol between 8 and 9 Å.
    terms = truncation_terms("shift" if name in SWITCHES else name, truncation, at)
    return ReactionField(cutoff, truncation, terms, field, charge_e * COULOMB_CHARGE)


def interactions(parts: SystemParts) -> Interactions:
    """The charges of a scene with electrostatics = "reaction_field", and "coulomb", which has no
    cutoff."""
    forces, (sites, charge) = parts.scene.forces, parts.charged()
    cutoff = (forces.cutoff_A if forces.electrostatics == "reaction_field" else None) or inf
    start = forces.switch_start_A or cutoff
    name = forces.reaction_field_truncation or "plain"
    potential = reaction_field(charge, cutoff, forces.reaction_field_permittivity, name, start)
    constants = {}
    if cutoff < inf:
        energy = parts.sum_over_molecules(lambda q, x: self_energy(potential._replace(charge=q), x))
        constants["reaction_field_self"] = energy
    return Interactions({"coulomb": parts.pair_forces(potential, sites)}, constants)


def setting_errors(forces: Forces, space: Space, cutoff: float) -> list[str]:
    """Messages on keys of [forces] that this box does not allow."""
    if forces.electrostatics == "coulomb" and space.volume < inf:
        return [
            "forces.electrostatics = 'coulomb' is for open boxes. In a periodic one use pme, ewald"
            " or reaction_field"
        ]
    return []


@chosen_by_type(inline=True)
def powers(truncation, switched, r2):
    """1/r, and two factors of 1/r³. Found without 1/r if the force does not need it."""
    if not needs_root(truncation, switched):
        return lambda truncation, switched, r2: inverse_root_and_cube(r2)

    def of_inverse(truncation, switched, r2):
        inverse = inverse_square_root(r2)
        return inverse, inverse, inverse * inverse

    return of_inverse


@kernel(inline=True, from_python=True)
def radial(potential, r2):
    """(energy, force/r) of two unit charges at squared distance r2, a number or a vector."""
    inverse, one, two = powers(potential.truncation, potential.switched, r2)
    u = inverse + potential.field * r2 + potential.terms[0]
    w = (
        1 + switch_term(potential.truncation, potential.switched, r2 * inverse)
    ) * one * two - 2 * potential.field
    w = w + correction(potential.truncation, potential.switched, r2)
    return truncated(potential.truncation, potential.terms, potential.switched, r2, inverse, u, w)


@implements(pairs.pair, ReactionField, inline=True)
def _pair(potential, i, j, r2):
    qq = potential.charge[i] * load(potential.charge, j)
    u, w = radial(potential, r2)
    return qq * u, qq * w


def self_energy(potential: ReactionField, position: np.ndarray) -> float:
    """Energy (u Å²/ps²) of the charges of one molecule in their reaction field, a constant.
    position (s, 3) of the charged sites of the molecule, in the order of the first s of
    potential.charge."""
    charge = potential.charge[: len(position)]
    energy = 0.5 * charge @ charge * potential.terms[0]
    for i in range(len(position)):
        for j in range(i):
            r2 = float(np.sum((position[i] - position[j]) ** 2))
            u = radial(potential, r2)[0] if r2 < potential.cutoff**2 else 0.0
            energy += charge[i] * charge[j] * (u - 1 / sqrt(r2))
    return float(energy)
