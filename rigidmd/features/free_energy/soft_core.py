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
from rigidmd.forces.parts import InnerPairs, Tail, sum_of_tails
from rigidmd.forces.potentials.truncation import Truncation, truncation_terms
from rigidmd.scene.forces import TruncationName

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
