"""Charges of a scene become terms: the law between pairs, what periodic images add, and constants of rigid molecules."""

from math import inf, pi
from typing import NamedTuple

import numpy as np

from rigidmd.errors import SceneError
from rigidmd.forces import ewald
from rigidmd.forces.coulomb import reaction_field, self_energy
from rigidmd.forces.ewald_errors import (
    FAREST,
    Charges,
    alpha_for,
    charges_of,
    mesh_error,
    mesh_for,
    radius_of,
    real_error,
    wave_error,
    waves_for,
)
from rigidmd.forces.pairs import pair_forces
from rigidmd.forces.screened import damped_self_energy, damped_shifted_force, screened_coulomb
from rigidmd.forces.sites import BodySites, CentralSites
from rigidmd.forces.space import Space, cell_of
from rigidmd.molecules import Molecule
from rigidmd.scene import MolecularScene
from rigidmd.units import COULOMB, KJ_PER_MOL

#: A sum of charges smaller than this share of the sum of their sizes is rounding.
NEUTRAL = 1e-10


class Charged(NamedTuple):
    """The charged sites of a system."""

    species: list[Molecule]
    index: np.ndarray  # (n,) species of each molecule
    frozen: np.ndarray  # (n,)
    chosen: list[np.ndarray]  # charged sites of each species
    sites: BodySites | CentralSites
    group: np.ndarray  # (s,) sites of one group do not act on one another

    @property
    def charge_e(self) -> np.ndarray:
        """Charges (s,) in e."""
        return np.concatenate([self.species[k].charges[self.chosen[k]] for k in self.index])

    def each(self, what) -> float:
        """Sum over molecules that move of what(charges (s,) in energy units, positions (s, 3)) of one."""
        total = 0.0
        for k, (m, c) in enumerate(zip(self.species, self.chosen, strict=True)):
            count = int(((self.index == k) & ~self.frozen).sum())
            total += count * what(ewald.in_energy_units(m.charges[c]), m.positions_body[c]) if count else 0.0
        return total


class Electrostatics(NamedTuple):
    """What charges add to a system."""

    terms: dict[str, NamedTuple]
    constants: dict[str, float]  # u Å²/ps²
    notes: list[str]


def electrostatics(scene: MolecularScene, charged: Charged, space: Space, cutoff: float, start: float):
    """Terms, constants and notes for charges; start : where a switch of the reaction field begins, Å."""
    forces = scene.forces

    def between_pairs(law):
        return pair_forces(law, space, charged.sites, forces.skin_A, scene.precision, charged.group)

    charge = charged.charge_e
    if forces.electrostatics == "reaction_field":
        law = reaction_field(charge, cutoff, forces.reaction_field_permittivity, forces.truncation, start)
        constants = {}
        if cutoff < inf:
            own = charged.each(lambda q, x: self_energy(law._replace(charge=q), x))
            constants["reaction_field_self"] = own
        return Electrostatics({"coulomb": between_pairs(law)}, constants, [])
    if forces.electrostatics == "damped_shifted_force":
        law = damped_shifted_force(charge, cutoff, forces.damping_per_A)
        own = charged.each(lambda q, x: damped_self_energy(law._replace(charge=q), x))
        return Electrostatics({"coulomb": between_pairs(law)}, {"damped_self": own}, [])
    return _ewald(scene, charged, space, cutoff, between_pairs)


def electrostatic_faults(scene: MolecularScene, space: Space, cutoff: float) -> list[str]:
    """What is wrong with a scene's electrostatics in this box."""
    forces = scene.forces
    method = forces.electrostatics
    faults = []
    if method in ("ewald", "pme") and space.volume == inf:
        faults.append(
            f"forces.electrostatics = {method!r} sums over the images of a periodic box, and there is none; "
            "use reaction_field, which without a box is Coulomb's plain law"
        )
    elif method == "damped_shifted_force" and cutoff == inf:
        faults.append("forces.electrostatics = 'damped_shifted_force' ends at a cut-off; give forces.cutoff_A")
    given = {"damped_shifted_force": "damping_per_A", "ewald": "ewald_alpha_per_A", "pme": "ewald_alpha_per_A"}
    if not faults and (key := given.get(method)) and (getattr(forces, key) or 0.0) * cutoff > FAREST:
        faults.append(
            f"forces.{key} = {getattr(forces, key):g} with a cut-off of {cutoff:g} Å screens charges by "
            f"erfc({getattr(forces, key) * cutoff:.3g}) there, far below rounding; at most {FAREST / cutoff:.3g} is of use"
        )
    return faults


def _ewald(scene: MolecularScene, charged: Charged, space: Space, cutoff: float, between_pairs) -> Electrostatics:
    forces, volume = scene.forces, space.volume
    charge = ewald.in_energy_units(charged.charge_e)
    net = charged.charge_e.sum()
    charges = charges_of(
        [
            (int((charged.index == k).sum()), m.charges[c], m.positions_body[c])
            for k, (m, c) in enumerate(zip(charged.species, charged.chosen, strict=True))
        ]
    )
    share = forces.ewald_accuracy / np.sqrt(2)
    alpha = forces.ewald_alpha_per_A or alpha_for(charges, cutoff, volume, share)
    if alpha * cutoff > FAREST:
        raise SceneError(
            scene.source,
            [f"forces.ewald_accuracy = {forces.ewald_accuracy:g} cannot be had with a cut-off of {cutoff:g} Å"],
        )
    law = screened_coulomb(charged.charge_e, cutoff, alpha)
    over, settings, waves_left = _reciprocal(scene, charged, charges, space, alpha, share, charge)
    terms = {"coulomb_real": between_pairs(law), "coulomb_reciprocal": over}
    constants = {
        "coulomb_self": charged.each(lambda q, x: ewald.self_energy(q, alpha)),
        "coulomb_intramolecular": charged.each(lambda q, x: ewald.intramolecular_energy(q, x, alpha)),
    }
    real_left = real_error(charges, alpha, cutoff, volume)
    estimate = float(np.hypot(real_left, waves_left))
    unit = COULOMB / KJ_PER_MOL
    notes = [
        f"{scene.forces.electrostatics}: alpha {alpha:.6g} 1/Å, cut-off {cutoff:g} Å, {settings}",
        f"estimated rms error of the force on a site {estimate:.2g} e²/Å² = {estimate * unit:.2g} kJ/(mol Å): "
        f"{real_left:.2g} from pairs beyond the cut-off, {waves_left:.2g} from the reciprocal part",
    ]
    if abs(net) > NEUTRAL * np.abs(charged.charge_e).sum():
        terms["coulomb_background"] = ewald.background(charge, alpha, space)
        notes.append(
            f"the box has a net charge of {net:+g} e, which an even background of the opposite charge makes neutral; "
            "energies and pressure then depend on the size of the box"
        )
        if forces.ewald_surface_permittivity < inf:
            raise SceneError(
                scene.source,
                [
                    f"forces.ewald_surface_permittivity: a box with a net charge, {net:+g} e, has no dipole of its own; "
                    "leave it out"
                ],
            )
    if forces.ewald_surface_permittivity < inf:
        terms["coulomb_surface"] = ewald.surface_dipole(charge, forces.ewald_surface_permittivity, space, charged.sites)
    return Electrostatics(terms, constants, notes)


def _reciprocal(
    scene: MolecularScene,
    charged: Charged,
    charges: Charges,
    space: Space,
    alpha: float,
    error: float,
    charge: np.ndarray,
):
    """The reciprocal term, its settings in words, and the error it leaves."""
    forces = scene.forces
    if forces.electrostatics == "pme":
        return _mesh(scene, charged, charges, space, alpha, error, charge)
    reciprocal = 2 * pi * np.linalg.inv(cell_of(space)).T
    if forces.ewald_k_max is not None:
        most = forces.ewald_k_max if isinstance(forces.ewald_k_max, tuple) else (forces.ewald_k_max,) * 3
        over = ewald.waves(most, forces.ewald_k2_max)
        if over.total == 0:
            raise SceneError(scene.source, ["forces.ewald_k_max and ewald_k2_max leave no wave at all"])
    else:
        over = waves_for(charges, alpha, reciprocal, error)
    left = wave_error(charges, alpha, radius_of(over.total, space.volume), space.volume)
    settings = f"{over.total} waves, |n| up to {' '.join(map(str, over.most))}"
    return ewald.ewald_sum(charge, alpha, space, charged.sites, over), settings, left


def _mesh(scene: MolecularScene, charged: Charged, charges: Charges, space: Space, alpha: float, error: float, charge):
    """The same on a grid."""
    from rigidmd.forces.pme import pme  # rocket-fft is for scenes with PME only

    forces, cell = scene.forces, cell_of(space)
    grid, order = forces.pme_grid, forces.pme_order
    if grid is None or order is None:
        found = mesh_for(charges, alpha, cell, error, order, grid)
        if found is None:
            given = " with this forces.pme_order or pme_grid" if order or grid else ""
            raise SceneError(
                scene.source,
                [
                    f"forces.ewald_accuracy = {forces.ewald_accuracy:g} cannot be had{given} at alpha = {alpha:.3g} 1/Å; "
                    "take a larger ewald_accuracy, a longer cutoff_A or a finer grid"
                ],
            )
        grid, order = found
    left = mesh_error(charges, alpha, cell, grid, order)
    dtype = np.float64 if scene.precision == "double" else np.float32
    settings = f"grid {' x '.join(map(str, grid))}, splines of order {order}"
    return pme(charge, alpha, space, charged.sites, grid, order, dtype), settings, left
