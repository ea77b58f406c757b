"""Energies of trial molecules with the sites of a system, pair by pair and without a list: each
trial has another position, and no forces are needed."""

from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.compile import chosen_by_type, is_a, kernel
from rigidmd.compile.simd import inverse_root_and_cube, inverse_square_root
from rigidmd.features.potentials.sites.custom import CustomPotential
from rigidmd.forces.neighbors import pair_loop as pairs
from rigidmd.forces.neighbors.space import image_in_box
from rigidmd.forces.potentials.coulomb import ReactionField, radial
from rigidmd.forces.potentials.lennard_jones import LennardJones, ScreenedDispersion
from rigidmd.forces.potentials.screened_coulomb import (
    DampedShiftedForce,
    ScreenedCoulomb,
    screened,
)

#: Distances at which the core of a potential is searched for, Å.
DISTANCES = np.geomspace(1e-2, 1e2, 9211)
POTENTIALS = (LennardJones, CustomPotential, ReactionField, DampedShiftedForce, ScreenedCoulomb)


class PairOfKinds(NamedTuple):
    """A potential between some sites of the trial molecule and some of the system."""

    potential: NamedTuple  # between two kinds, or between unit charges
    core: float  # Å, the trial molecule overlaps where sites are nearer than this
    guest: np.ndarray  # (g,) sites of the trial molecule, indices in the term
    host: np.ndarray  # (h,) sites of the system, indices in the term
    guest_strength: np.ndarray  # (g,) factors of the energy
    host_strength: np.ndarray  # (h,)


def pairs_of_kinds(
    potential: NamedTuple, guest: np.ndarray, host: np.ndarray, core_energy: float
) -> list[PairOfKinds]:
    """The pairs of kinds of a potential of `POTENTIALS`.

    guest, host : indices of sites in its term; core_energy : u Å²/ps²
    """
    if not isinstance(potential, LennardJones | CustomPotential):
        charge = potential.charge  # type: ignore[attr-defined]
        unit = (
            potential.for_slots(1, np.float64)
            if isinstance(potential, ReactionField)
            else potential
        )
        return [PairOfKinds(unit, 0.0, guest, host, charge[guest], charge[host])]
    found = []
    for i in np.unique(potential.kind[guest]):
        for j in np.unique(potential.kind[host]):
            if isinstance(potential, CustomPotential) and not potential.interacts[i, j]:
                continue
            unit = _between(potential, int(i), int(j)).for_slots(1, np.float64)
            of_kind = guest[potential.kind[guest] == i], host[potential.kind[host] == j]
            core = _core_of(unit, core_energy)
            found.append(PairOfKinds(unit, core, *of_kind, *(np.ones(len(k)) for k in of_kind)))
    return found


def _between(
    potential: LennardJones | CustomPotential, i: int, j: int
) -> LennardJones | CustomPotential:
    """The potential with the numbers of two kinds, as one of a single kind."""
    pair = slice(i, i + 1), slice(j, j + 1)
    kind = np.zeros(1, np.int32)
    if isinstance(potential, CustomPotential):
        return potential._replace(
            kind=kind,
            parameters=potential.parameters[:, *pair],
            terms_of_kinds=potential.terms_of_kinds[:, *pair],
            interacts=potential.interacts[pair],
            formula=type(potential.formula)(*potential.parameters[:, i, j].tolist()),
        )
    dispersion = potential.dispersion
    if isinstance(dispersion, ScreenedDispersion):
        of_kinds = [dispersion.strength[potential.kind == k][0] for k in (i, j)]  # type: ignore[index]
        dispersion = dispersion._replace(strength=np.array([sqrt(of_kinds[0] * of_kinds[1])]))
    return potential._replace(
        kind=kind, c12=potential.c12[pair], c6=potential.c6[pair], dispersion=dispersion
    )


def _core_of(potential: NamedTuple, energy: float) -> float:
    """The largest distance (Å) at which a pair has this energy or more; 0 if there is none."""
    inside = DISTANCES[potential.cutoff > DISTANCES]  # type: ignore[attr-defined]
    high = np.flatnonzero(~(_energies(potential, inside) < energy))
    return float(inside[high[-1]]) if len(high) else 0.0


@chosen_by_type(inline=True)
def unit_energy(potential, r2):
    """Energy of a pair with the numbers of the potential, or with two unit charges."""
    if is_a(potential, ReactionField):
        return lambda potential, r2: radial(potential, r2)[0]
    if is_a(potential, ScreenedCoulomb):

        def of_ewald_sum(potential, r2):
            inverse, one, two = inverse_root_and_cube(r2)
            return screened(potential.screening, inverse, (one, two), r2)[0] - potential.shift

        return of_ewald_sum
    if is_a(potential, DampedShiftedForce):

        def of_shifted_force(potential, r2):
            inverse = inverse_square_root(r2)
            u = screened(potential.screening, inverse, (inverse, inverse * inverse), r2)[0]
            return u + potential.slope * (r2 * inverse) + potential.shift

        return of_shifted_force
    return lambda potential, r2: pairs.pair(potential, 0, 0, r2)[0]


@kernel(from_python=True)
def _energies(potential, distance):
    """Energies (k,) at distances (k,) below the cutoff."""
    energy = np.zeros(len(distance))
    for k in range(len(distance)):
        energy[k] = unit_energy(potential, distance[k] * distance[k])
    return energy


@kernel(from_python=True)
def add_guest_energies(potential, core, guest, host, guest_strength, host_strength, cell, energy):
    """Add the energies between trial molecules and the nearest images of a system's sites.

    guest (m, g, 3), host (h, 3) : sites, Å; strengths (g,) and (h,)
    cell (3, 3) : as in `State`; images within half its shortest diagonal element are the nearest
    energy (m,) : u Å²/ps²; becomes inf where two sites are nearer than `core`
    """
    periodic = cell[0, 0] < inf
    reach = potential.cutoff * potential.cutoff
    least = core * core
    for m in range(len(guest)):
        total = 0.0
        for a in range(guest.shape[1]):
            for b in range(len(host)):
                dx = guest[m, a, 0] - host[b, 0]
                dy = guest[m, a, 1] - host[b, 1]
                dz = guest[m, a, 2] - host[b, 2]
                if periodic:
                    dx, dy, dz = image_in_box(cell, dx, dy, dz)
                r2 = dx * dx + dy * dy + dz * dz
                if r2 < least:
                    total = inf
                    break
                if r2 < reach:
                    total += guest_strength[a] * host_strength[b] * unit_energy(potential, r2)
            if total == inf:
                break
        energy[m] += total
