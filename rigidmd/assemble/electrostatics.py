"""The electrostatics of a resolved scene: pair potential, reciprocal part, constants of rigid molecules."""

from collections.abc import Callable
from math import inf, pi
from typing import NamedTuple

import numpy as np

from rigidmd.core.state import State
from rigidmd.engines.system import charges_in
from rigidmd.errors import SceneError
from rigidmd.forces.ewald import corrections, direct_sum, k_vectors
from rigidmd.forces.ewald.errors import Charges, k_cutoff_for, k_cutoff_of_count, k_space_error, pme_error, real_error
from rigidmd.forces.neighbors.pair_loop import pair_forces
from rigidmd.forces.neighbors.sites import BodySites, CentralSites
from rigidmd.forces.neighbors.space import Space, cell_of
from rigidmd.forces.potentials.coulomb import reaction_field, self_energy
from rigidmd.forces.potentials.lennard_jones import Tail
from rigidmd.forces.potentials.screened_coulomb import damped_self_energy, damped_shifted_force, screened_coulomb
from rigidmd.scene import MolecularScene
from rigidmd.scene.models import Molecule, gather_per_molecule
from rigidmd.scene.validation import not_none
from rigidmd.units import COULOMB, COULOMB_CHARGE, KJ_PER_MOL

#: A net charge below this fraction of the sum of |q| is rounding.
NEUTRAL = 1e-10
#: Largest error of the polynomials in single precision between unit charges, as a fraction of the real-space error.
#: With it the measured error of PME on 4096 waters, 3.3e-5 e²/Å², is the same as with all terms of the polynomials.
FIT_ERROR_FRACTION = 0.02

Grid = tuple[int, int, int]


class ChargedSites(NamedTuple):
    """The charged sites of a system."""

    species: list[Molecule]
    species_index: np.ndarray  # (n,) of each molecule
    frozen: np.ndarray  # (n,)
    indices: list[np.ndarray]  # charged sites of each species
    sites: BodySites | CentralSites
    group: np.ndarray  # (s,) sites of one group do not act on each other

    @property
    def charge_e(self) -> np.ndarray:
        """Charges (s,) in e."""
        return gather_per_molecule(
            [m.charges[c] for m, c in zip(self.species, self.indices, strict=True)], self.species_index
        )

    @property
    def summed(self) -> Charges:
        """All charges, in the form that error estimates need."""
        return charges_in(self.species, np.bincount(self.species_index, minlength=len(self.species)))

    def sum_over_molecules(self, energy: Callable[[np.ndarray, np.ndarray], float]) -> float:
        """Sum of energy(charges (s,) in energy units, positions (s, 3)) over the molecules that are not frozen."""
        total = 0.0
        for k, (m, c) in enumerate(zip(self.species, self.indices, strict=True)):
            count = int(((self.species_index == k) & ~self.frozen).sum())
            total += count * energy(m.charges[c] * COULOMB_CHARGE, m.positions_body[c]) if count else 0.0
        return total


class Interactions(NamedTuple):
    """The terms, constants and corrections of the interactions between molecules."""

    terms: dict[str, NamedTuple]
    constants: dict[str, float]  # constant energies, u Å²/ps²
    pressure: float = 0.0  # a constant part of the pressure, u/(Å ps²)
    tail: Tail | None = None  # where the scene asks for it
    force_error: float | None = None  # estimated rms error of the Coulomb force on a site, u Å/ps²; with Ewald sums
    notes: tuple[str, ...] = ()


def electrostatics(
    scene: MolecularScene, charged: ChargedSites, space: Space, state: State, basis: np.ndarray, grid: Grid | None
) -> Interactions:
    """The contributions of the charges of a resolved scene. Raises SceneError.

    basis (3, 3) : integers, the edges of the box in terms of the edges of the given cell, to which ewald_k_max refers
    grid : of PME, along the edges of the box
    """
    forces, cutoff = scene.forces, scene.forces.cutoff_A or inf

    def between_pairs(potential: NamedTuple) -> NamedTuple:
        return pair_forces(potential, charged.sites, charged.group)

    charge = charged.charge_e
    if forces.electrostatics == "reaction_field":
        start = forces.switch_start_A or cutoff
        potential = reaction_field(charge, cutoff, forces.reaction_field_permittivity, forces.truncation, start)
        constant = (
            charged.sum_over_molecules(lambda q, x: self_energy(potential._replace(charge=q), x))
            if cutoff < inf
            else None
        )
        return Interactions(
            {"coulomb": between_pairs(potential)}, {} if constant is None else {"reaction_field_self": constant}
        )
    if forces.electrostatics == "damped_shifted_force":
        potential = damped_shifted_force(charge, cutoff, forces.damping_per_A)
        constant = charged.sum_over_molecules(lambda q, x: damped_self_energy(potential._replace(charge=q), x))
        return Interactions({"coulomb": between_pairs(potential)}, {"damped_self": constant})
    return _ewald(scene, charged, space, between_pairs, state, basis, grid)


class _Ewald(NamedTuple):
    """Truncation errors and k-vectors of an Ewald sum."""

    real_error: float  # e²/Å², see ewald_errors
    k_space_error: float
    vectors: k_vectors.KVectors | None  # with PME only for the interactions of frozen molecules


def _ewald_errors(
    scene: MolecularScene, charged: ChargedSites, space: Space, basis: np.ndarray, grid: Grid | None
) -> _Ewald:
    """Truncation errors and k-vectors of a resolved scene."""
    forces, volume, cell = scene.forces, space.volume, cell_of(space)
    alpha, cutoff, charges = not_none(forces.ewald_alpha_per_A), not_none(forces.cutoff_A), charged.summed
    of_real_space = real_error(charges, alpha, cutoff, volume)
    reciprocal = 2 * pi * np.linalg.inv(cell).T
    if grid is not None:
        of_k_space = pme_error(charges, alpha, cell, grid, not_none(forces.pme_order))
        vectors = None
        if charged.frozen.any():
            vectors = k_vectors.k_vectors_within(
                reciprocal, k_cutoff_for(charges, alpha, reciprocal, 1e-3 * of_k_space)
            )
        return _Ewald(of_real_space, of_k_space, vectors)
    most, radius = forces.ewald_k_max, forces.ewald_k_radius_per_A
    if isinstance(most, int):
        most = (most, most, most)
    if radius is None:
        vectors = k_vectors.k_vectors_up_to(not_none(most), forces.ewald_k2_max, basis)
    else:
        vectors = k_vectors.k_vectors_within(reciprocal, radius, most, basis)
    if vectors.total == 0:
        raise SceneError(scene.source, ["forces.ewald_k_max or ewald_k_radius_per_A leaves no k-vector"])
    return _Ewald(
        of_real_space, k_space_error(charges, alpha, k_cutoff_of_count(vectors.total, volume), volume), vectors
    )


def _ewald(
    scene: MolecularScene, charged: ChargedSites, space: Space, between_pairs: Callable[[NamedTuple], NamedTuple],
    state: State, basis: np.ndarray, grid: Grid | None,
) -> Interactions:  # fmt: skip
    forces, found = scene.forces, _ewald_errors(scene, charged, space, basis, grid)
    alpha, cutoff = not_none(forces.ewald_alpha_per_A), not_none(forces.cutoff_A)
    charge = charged.charge_e * COULOMB_CHARGE
    shifted = forces.ewald_truncation == "shift"
    potential = screened_coulomb(charged.charge_e, cutoff, alpha, shifted, FIT_ERROR_FRACTION * found.real_error)
    if grid is None:
        vectors = not_none(found.vectors)
        reciprocal = direct_sum.EwaldSum(alpha, charge, charged.sites, vectors)
        how = f"{vectors.total} k-vectors, |n| up to {' '.join(map(str, vectors.most))}"
        if forces.ewald_k_max is not None and not np.array_equal(basis, k_vectors.SAME_BASIS):
            how += "; they are the k-vectors that ewald_k_max means in the given cell"
    else:
        from rigidmd.forces.ewald.pme import Pme  # rocket-fft is for scenes with PME only

        order = not_none(forces.pme_order)
        reciprocal = Pme(alpha, charge, charged.sites, grid, order)
        how = f"grid {' x '.join(map(str, grid))}, splines of order {order}"
    terms = {"coulomb_real": between_pairs(potential), "coulomb_reciprocal": reciprocal}
    constants = {
        # The shift applies to all charges within the cutoff of a charge, which together are nearly neutral, including
        # the charge itself and its molecule. The pair loop leaves these out; this constant adds them.
        "coulomb_self": charged.sum_over_molecules(
            lambda q, x: corrections.self_energy(q, alpha) - 0.5 * potential.shift * float(q.sum()) ** 2
        ),
        "coulomb_intramolecular": charged.sum_over_molecules(
            lambda q, x: corrections.intramolecular_energy(q, x, alpha)
        ),
    }
    error = float(np.hypot(found.real_error, found.k_space_error))
    notes = [
        f"{forces.electrostatics}: alpha {alpha:.6g} 1/Å, cutoff {cutoff:g} Å, {how}"
        + ("" if potential.shift == 0 else "; energies of real space shifted to 0 at the cutoff"),
        f"estimated rms error of the force on a site: {error:.2g} e²/Å² = {error * COULOMB / KJ_PER_MOL:.2g} "
        f"kJ/(mol Å); {found.real_error:.2g} beyond the cutoff, {found.k_space_error:.2g} in the reciprocal part",
    ]
    frozen_sites = charged.frozen[charged.sites.molecule]
    net, net_frozen = charge.sum(), charge[frozen_sites].sum()
    neutral = abs(net) <= NEUTRAL * np.abs(charge).sum()
    if not neutral:
        terms["coulomb_background"] = corrections.background(net**2 - net_frozen**2, alpha)
        notes.append(
            f"the box has a net charge of {charged.charge_e.sum():+.6g} e; an even background of the opposite charge "
            "makes it neutral, and energies and pressure depend on the size of the box"
        )
    if (permittivity := forces.ewald_surface_permittivity) < inf:
        if not neutral:
            fault = (
                "forces.ewald_surface_permittivity: the dipole of a box with a net charge is not defined; leave it out"
            )
            raise SceneError(scene.source, [fault])
        terms["coulomb_surface"] = corrections.surface_dipole(charge, permittivity, charged.sites)
    pressure = 0.0
    if frozen_sites.any():
        constants["coulomb_frozen"], pressure = _frozen_correction(
            charged, charge * frozen_sites, space, alpha, not_none(found.vectors), permittivity, state
        )
    return Interactions(terms, constants, pressure, None, error * COULOMB, tuple(notes))


def _frozen_correction(
    charged: ChargedSites, charge: np.ndarray, space: Space, alpha: float, vectors: k_vectors.KVectors,
    permittivity: float, state: State,
) -> tuple[float, float]:  # fmt: skip
    """Constant energy and pressure that cancel the interactions between frozen molecules in sums over images. charge
    (s,) is 0 for sites that move."""
    sites, volume = charged.sites, space.volume
    arms = np.zeros((len(charge), 3))
    if len(state.rotation):
        arms = np.einsum("sij,sj->si", state.rotation[sites.molecule], sites.offsets())
    position = state.position[sites.molecule] + arms
    energy, force, virial = direct_sum.ewald_sum_in_numpy(charge, position, cell_of(space), alpha, vectors)
    dipole = charge @ position
    surface = 2 * pi / ((2 * permittivity + 1) * volume)
    force -= 2 * surface * charge[:, None] * dipole
    energy += surface * float(dipole @ dipole)
    trace = float(virial.trace()) + 3 * surface * float(dipole @ dipole)
    trace -= 2 * surface * float(dipole @ dipole) + float((force * arms).sum())
    return -energy, -trace / (3 * volume)
