"""Lennard-Jones forces of molecules that appear: with a soft core, so that they are finite
everywhere.

lambda 4 epsilon (1/s² - 1/s) with s = (r/sigma)⁶ + (1 - lambda)/2 (Beutler et al. 1994, Chem. Phys.
Lett. 222, 529), which is Lennard-Jones at lambda = 1.
"""

from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements
from rigidmd.compile.simd import inverse
from rigidmd.features.potentials.sites.custom import (
    CustomPotential,
    energy_and_force_at,
    tail_of_pair,
)
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.forces.neighbors.sites import exclusion_groups
from rigidmd.forces.parts import InnerPairs, Interactions, SystemParts, Tail, sum_of_tails
from rigidmd.forces.potentials import lennard_jones
from rigidmd.forces.potentials.truncation import Truncation, truncation_terms
from rigidmd.scene.truncation import TruncationName
from rigidmd.scene.validation import not_none

SOFTNESS = 0.5  # at lambda = 0, the alpha of the paper


class SoftCore(NamedTuple):
    """c12/s² - c6/s with s = r⁶ + softness."""

    c12: float  # u Å¹⁴/ps²
    c6: float  # u Å⁸/ps²
    softness: float  # Å⁶

    uses_root = False

    def radial(self, r: float) -> tuple[float, float, float]:
        """The energy v at a distance, -v' and -v''."""
        x = 1 / (r**6 + self.softness)
        by_x = 2 * self.c12 * x - self.c6
        force = 6 * r**5 * x**2 * by_x
        slope = (5 / r - 12 * r**5 * x) * force - 72 * r**10 * x**4 * self.c12
        return (self.c12 * x - self.c6) * x, force, slope


@implements(energy_and_force_at, SoftCore, inline=True)
def _of_soft_core(formula, shared, r2, inverse1, inverse2):
    x = inverse(r2 * r2 * r2 + formula.softness)
    force = 6.0 * (2.0 * formula.c12 * x - formula.c6) * x * x * r2 * r2
    return (formula.c12 * x - formula.c6) * x, force


def soft_core(
    c12: np.ndarray,
    c6: np.ndarray,
    kind: np.ndarray,
    is_coupled: np.ndarray,
    coupled_by: float,
    truncation: Truncation,
    name: TruncationName,
) -> CustomPotential:
    """The potential of the pairs of kinds of which at least one is coupled.

    c12, c6 : (kinds, kinds) as in `LennardJones`; kind : (s,) of each site; is_coupled : (kinds,)
    coupled_by : lambda of these forces
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma6 = np.where(c6 > 0, c12 / c6, 0.0)
    softness = SOFTNESS * (1 - coupled_by) * sigma6
    numbers = np.array([coupled_by * c12, coupled_by * c6, softness])
    interacts = is_coupled[:, None] | is_coupled
    terms = np.zeros((4, *c12.shape))
    for i, j in np.argwhere(interacts):
        terms[:, i, j] = truncation_terms(name, truncation, SoftCore(*numbers[:, i, j]).radial)
    return CustomPotential(
        truncation.cutoff,
        truncation,
        SoftCore(*numbers[:, -1, -1].tolist()),
        (),
        kind,
        numbers,
        terms,
        interacts.astype(float),
    )


def tail_of_soft_core(potential: CustomPotential, inner: InnerPairs) -> Tail | None:
    """Its tail correction. inner : the pairs inside molecules"""
    count = np.bincount(potential.kind, minlength=len(potential.interacts))
    tails = []
    for i, j in np.argwhere(np.triu(potential.interacts) > 0):
        tail = tail_of_pair(
            SoftCore(*potential.parameters[:, i, j]).radial,
            tuple(potential.terms_of_kinds[:, i, j]),
            potential.truncation,
            inner.between(i, j),
        )
        pairs = count[i] * count[j] * (1.0 if i == j else 2.0)
        tails.append(Tail(pairs * tail.energy_volume, pairs * tail.pressure_square, tail.constant))
    return sum_of_tails(tails)


def interactions(parts: SystemParts) -> Interactions:
    """Lennard-Jones forces between the sites without a soft core, and those of all others. Raises
    SceneError."""
    forces, coupling = parts.scene.forces, not_none(parts.scene.coupling)
    soft = [m.name == coupling.species for m in parts.species]
    found = lennard_jones.sites_of_scene(parts, soft)
    if found is None or not found.is_separate.any():
        return lennard_jones.interactions(parts)
    potential, is_soft_kind, indices, inner, notes = found
    plain_kinds = ~is_soft_kind
    softened = soft_core(
        potential.c12,
        potential.c6,
        potential.kind,
        is_soft_kind,
        coupling.lennard_jones,
        potential.truncation,
        forces.truncation,
    )
    sites = parts.sites(indices)
    # one group of all molecules without a soft core, which have no pairs here
    groups = exclusion_groups(sites, ~np.array(soft)[parts.model.species])
    terms = {"soft_core": PairForces(softened, sites, groups)}
    tails = [] if inner is None else [tail_of_soft_core(softened, inner)]
    if count := int(plain_kinds.sum()):
        plain = potential._replace(
            kind=potential.kind[plain_kinds[potential.kind]],
            c12=potential.c12[:count, :count],
            c6=potential.c6[:count, :count],
        )
        no_sites = np.zeros(0, dtype=int)
        plain_sites = [no_sites if s else i for i, s in zip(indices, soft, strict=True)]
        terms["lennard_jones"] = parts.pair_forces(plain, parts.sites(plain_sites))
        if inner is not None:
            inside = InnerPairs(*(column[plain_kinds[inner.one]] for column in inner))
            tails.append(lennard_jones.tail(plain, inside))
    total = sum_of_tails([tail for tail in tails if tail is not None])
    return Interactions(terms, {}, tail=total, notes=notes)
