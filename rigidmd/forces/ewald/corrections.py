"""Correction terms of an Ewald sum. `direct_sum` has the whole formula."""

from math import pi, sqrt
from typing import NamedTuple

import numpy as np
from scipy.special import erf

from rigidmd.compile import implements
from rigidmd.core.state import OK
from rigidmd.forces import terms
from rigidmd.forces.neighbors.sites import (
    BodySites,
    CentralSites,
    compute_site_positions,
    load_molecule,
)
from rigidmd.forces.neighbors.space import volume_of
from rigidmd.forces.terms import Setup


class Background(NamedTuple):
    """The uniform background charge that neutralises a charged box."""

    strength: float  # energy times the volume, u Å⁵/ps²

    acts_on_charges = True


def background(square: float, alpha: float) -> Background:
    """The term for the square of a net charge, in units where q²/r is an energy in u Å²/ps²."""
    return Background(-pi / (2 * alpha**2) * square)


class MeanDispersion(NamedTuple):
    """The k-vector 0 of dispersion: the attraction of uniform densities, energy -pi^(3/2) beta³/(6
    V) (sum of c)²."""

    strength: float  # energy times the volume, u Å⁵/ps²


@implements(terms.add_forces, (Background, MeanDispersion))
def _add_background(term, state, load, tally):
    if tally is not None:
        energy = term.strength / volume_of(state.cell)
        for k in (0, 1, 5, 9):
            tally[k] += energy
    return OK


class SurfaceDipole(NamedTuple):
    """Response of the surroundings of all images to their dipole M = sum q r: energy sum_k
    strength_k M_k² / V.

    A medium around a large sphere of boxes has the strength 2 pi/(2 eps + 1) along each axis. A
    slab in vacuum has 2 pi along its normal (Yeh & Berkowitz 1999, J. Chem. Phys. 111, 3155, eq.
    10), which leaves the field of a single slab.
    """

    strength: tuple[float, float, float]
    charge: np.ndarray  # (s,) sum to 0, in units where q²/r is an energy in u Å²/ps²
    sites: BodySites | CentralSites

    acts_on_charges = True

    def workspace(self, setup: Setup) -> "SurfaceWorkspace":
        return SurfaceWorkspace(*self, *np.zeros((2, len(self.charge), 3)))


class SurfaceWorkspace(NamedTuple):
    strength: tuple[float, float, float]
    charge: np.ndarray
    sites: BodySites | CentralSites
    position: np.ndarray  # (s, 3)
    site_force: np.ndarray  # (s, 3) as last evaluated, lab frame, u Å/ps²


@implements(terms.add_forces, SurfaceWorkspace)
def _add_surface_dipole(term, state, load, tally):
    compute_site_positions(term.sites, state, term.position)
    volume = volume_of(state.cell)
    energy = 0.0
    for k in range(3):
        dipole = 0.0
        per_dipole_square = term.strength[k] / volume
        for i in range(len(term.charge)):
            dipole += term.charge[i] * term.position[i, k]
        for i in range(len(term.charge)):
            term.site_force[i, k] = -2 * per_dipole_square * term.charge[i] * dipole
        energy += per_dipole_square * dipole * dipole
    if tally is not None:
        # the virial: f (x) x of the sites at fixed volume, and the energy, which is proportional to
        # 1/V
        for k in (0, 1, 5, 9):
            tally[k] += energy
        for i in range(len(term.charge)):
            for row in range(3):
                for k in range(3):
                    m = term.sites.molecule[i]
                    tally[1 + 3 * row + k] += term.site_force[i, row] * state.position[m, k]
    for m in range(len(state.position)):
        load_molecule(term.sites, state, load, m, term.site_force)
    return OK


def self_energy(charge: np.ndarray, alpha: float) -> float:
    """Energy that removes the interaction of each charge with its own screening charge. charge (s,)
    in units where q²/r is an energy in u Å²/ps²"""
    return -alpha / sqrt(pi) * float(charge @ charge)


def intramolecular_energy(charge: np.ndarray, position: np.ndarray, alpha: float) -> float:
    """Energy that removes the pairs inside one molecule from the sum over k, a constant. Position
    (s, 3) in Å."""
    i, j = np.triu_indices(len(charge), 1)
    r = np.linalg.norm(position[i] - position[j], axis=1)
    return -float(np.sum(charge[i] * charge[j] * erf(alpha * r) / r))
